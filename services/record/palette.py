"""Colours of hand, object and constraints in every picture, recording and export: red, green, blue from 0 to 1."""

Colour = tuple[float, float, float]

SKIN: Colour = (0.70, 0.73, 0.79)
OBJECT: Colour = (0.95, 0.62, 0.24)
TABLE: Colour = (0.80, 0.79, 0.77)
HEADING: Colour = (0.22, 0.40, 0.86)
"""Also reference poses."""
WAYPOINT: Colour = (0.53, 0.30, 0.75)
INK = "#262b35"
"""Text and titles."""
