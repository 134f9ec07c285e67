"""Appearance of hand, object and constraints in every picture, recording, export and page."""
