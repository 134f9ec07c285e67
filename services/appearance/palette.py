"""Colours of hand, object and constraints: red, green, blue from 0 to 1."""

Colour = tuple[float, float, float]

FLESH: Colour = (0.86, 0.65, 0.54)
"""Colour of a human hand."""
ROBOT_LINK: Colour = (0.70, 0.73, 0.79)
"""Colour of robots' links, and of capsules."""
ROBOT_JOINT: Colour = (0.30, 0.32, 0.37)
MATERIAL_COLOURS = {
    "flesh": FLESH,
    "nail": (0.94, 0.77, 0.70),
    "sleeve": (0.22, 0.28, 0.38),
    "link": ROBOT_LINK,
    "joint": ROBOT_JOINT,
}
"""Colours of the materials in `common.hands.skin.MATERIALS`, by name."""
OBJECT: Colour = (0.95, 0.62, 0.24)
TABLE: Colour = (0.80, 0.79, 0.77)
HEADING: Colour = (0.22, 0.40, 0.86)
"""Colour of headings and reference poses."""
WAYPOINT: Colour = (0.53, 0.30, 0.75)
GRASPABLE: Colour = (0.20, 0.65, 0.32)
AVOID: Colour = (0.80, 0.16, 0.16)
PIECES: tuple[Colour, ...] = (
    (0.90, 0.45, 0.36),
    (0.35, 0.63, 0.78),
    (0.95, 0.72, 0.30),
    (0.45, 0.70, 0.48),
    (0.66, 0.52, 0.78),
)
"""Colours of convex pieces, in turn."""
INK = "#262b35"
"""Colour of text and titles."""
