"""Version of the drawing of pictures and films."""

RENDERER_VERSION = 2
"""Raised by every change that makes the same episode or object look different.

Pictures of the pages carry it in the files next to them (`tests.pictures`).
"""
