"""Contrast of colours by WCAG 2.2."""

import re

LEAST_TEXT = 4.5
"""Level AA for text (criterion 1.4.3)."""

LEAST_CONTROL = 3.0
"""Level AA for controls and graphics (criterion 1.4.11)."""


def channels(colour: str) -> tuple[float, float, float]:
    """Red, green and blue in 0 to 1 of "#rrggbb"; an alpha is ignored."""
    match = re.fullmatch(r"#(..)(..)(..)(?:..)?", colour.strip())
    assert match, colour
    red, green, blue = (int(digits, 16) / 255 for digits in match.groups())
    return red, green, blue


def luminance(colour: str) -> float:
    """Relative luminance in 0 to 1."""
    linear = [
        value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4
        for value in channels(colour)
    ]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, other: str) -> float:
    """Ratio of two colours' luminances, 1 to 21."""
    lower, higher = sorted((luminance(one), luminance(other)))
    return (higher + 0.05) / (lower + 0.05)
