"""The studio's palette: contrast of every pair of colours that the style sheet and the canvases put
on one another, in light and dark.
"""

import pathlib
import re

import pytest

from tests.contrast import LEAST_CONTROL, LEAST_TEXT, contrast

ROOT = pathlib.Path(__file__).resolve().parents[3]
STYLE = (ROOT / "services" / "studio" / "static" / "style.css").read_text()

SURFACES = ("panel", "page", "stage")
TEXTS = {
    "ink": (*SURFACES, "note", "hover", "table"),
    "quiet": (*SURFACES, "chip", "hover", "note"),
    "good": ("panel", "page"),
    "warn": ("panel", "page"),
    "bad": ("panel", "page"),
    "on-accent": ("accent",),
    "on-ink": ("on-chip",),
}
"""Text colours and the backgrounds they are on."""

CONTROLS = {
    "edge": SURFACES,
    "accent": (*SURFACES, "hover"),
    "met": ("panel",),
    "unmet": ("panel",),
    "idle": ("panel",),
    "force": ("panel",),
    "good": ("chip",),
    "quiet": ("panel",),
    **{f"curve-{number}": ("panel",) for number in range(1, 7)},
}
"""Edges of controls, the ring of the focus, lanes, bars and curves, and what is behind them."""


def palettes():
    light, dark = re.findall(r":root \{(.*?)\}", STYLE, re.S)
    for name, text in (("light", light), ("dark", dark)):
        yield name, dict(re.findall(r"--([\w-]+): (#\w+)", text))


def pairs():
    for scheme, palette in palettes():
        for table, least in ((TEXTS, LEAST_TEXT), (CONTROLS, LEAST_CONTROL)):
            for front, backs in table.items():
                for back in backs:
                    yield pytest.param(
                        palette[front], palette[back], least, id=f"{scheme}: {front} on {back}"
                    )


def test_black_on_white_has_contrast_21():
    assert contrast("#000000", "#ffffff") == pytest.approx(21.0)
    assert contrast("#767676", "#ffffff") == pytest.approx(4.54, abs=0.01)


@pytest.mark.parametrize(("front", "back", "least"), pairs())
def test_contrast_is_sufficient(front, back, least):
    assert contrast(front, back) >= least
