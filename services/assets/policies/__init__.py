"""Policies of releases that are not part of the package: their index, and downloads."""
