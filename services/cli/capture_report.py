"""Printed report of `congrasp constraints import`: kept and dropped sequences, and why."""

import pathlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from congrasp.services.cli.console import say, show_table

if TYPE_CHECKING:
    from congrasp.services.assets.captures.report import Report

REPORT = "import.json"
"""File next to imported sets with the outcome of each sequence."""

_Row = dict[str, Any]
"""Outcome of a kept sequence, as in the file."""


def print_report(report: "Report", hand: str, out: pathlib.Path, objects: pathlib.Path) -> None:
    """Prints what was kept, what each rule dropped, and the locations of the results.

    Args:
      report: outcome of each sequence.
      hand: name of the hand of the sets.
      out: folder of the sets.
      objects: folder of the objects.
    """
    kept = report.kept
    say(f"{len(kept)} of {len(kept) + len(report.dropped)} sequences kept.")
    if report.dropped:
        rows = [(str(count), rule, example) for rule, count, example in report.rules()]
        show_table(("dropped", "why", "for example"), rows)
    if kept:
        _print_finger_angles(kept, hand)
        _print_separations(kept)
        _print_late_references(kept)
        _print_table_room(kept)
        _print_unused(kept, from_below=True, reason="from below, which no episode does")
        _print_unused(kept, from_below=False, reason="too near to the table")
        _print_split(kept)
        count = len({row["object"] for row in kept})
        say(f"Constraint sets ({count}) are in {out}, their objects in {objects}.")
    say(f"{out / REPORT} holds the outcome of each sequence.")


def _print_finger_angles(kept: Sequence[_Row], hand: str) -> None:
    """Prints the errors of the human hand's finger angles, or that another hand has none."""
    if hand != "human":
        say(
            f"A human's finger angles do not fit the hand '{hand}' and were dropped. Heading, "
            "affordance and wrist trajectory were kept; its fingers close around the object where "
            "the trajectory ends."
        )
        return
    worst = max(kept, key=lambda row: row["residual_rad"])
    mean = _mean([row["residual_rad"] for row in kept])
    say(
        f"Finger angles differ by {mean:.3f} rad per bone on average, at most "
        f"{worst['residual_rad']:.3f} rad ({worst['sequence']})."
    )


def _print_separations(kept: Sequence[_Row]) -> None:
    """Prints how deep fingers overlapped, and how far they were moved apart, if any were."""
    separated = [row for row in kept if row["moved_apart_rad"]]
    if not separated:
        return
    deepest = max(separated, key=lambda row: row["overlap_m"])
    farthest = max(separated, key=lambda row: row["moved_apart_rad"])
    mean = _mean([row["moved_apart_rad"] for row in separated])
    say(
        f"Fingers of {len(separated)} overlapped, by up to {1e3 * deepest['overlap_m']:.1f} mm "
        f"({deepest['sequence']}). They were separated: their farthest joint by {mean:.2f} rad on "
        f"average, at most {farthest['moved_apart_rad']:.2f} rad ({farthest['sequence']})."
    )


def _print_late_references(kept: Sequence[_Row]) -> None:
    """Prints the delays of references that are taken after the first touch, if any are."""
    delays = [row["frames_after_touch"] for row in kept if row["frames_after_touch"]]
    if not delays:
        return
    say(
        f"In {len(delays)} of {len(kept)}, thumb and fingers oppose only after the first touch; "
        f"the reference is taken then, {_mean(delays):.0f} frames later on average."
    )


def _print_table_room(kept: Sequence[_Row]) -> None:
    """Prints the number of grasps that are possible on the table."""
    count = sum(row["clear_of_table"] for row in kept)
    say(f"The table leaves room for {count} of {len(kept)} in some resting pose of their objects.")


def _print_unused(kept: Sequence[_Row], *, from_below: bool, reason: str) -> None:
    """Prints the sequences without room on the table, for one of the two reasons."""
    names = []
    for row in kept:
        if not row["clear_of_table"] and row["from_below"] == from_below:
            names.append(row["sequence"])
    if names:
        say(
            f"No episode is drawn from {len(names)}, whose hand comes {reason}: {', '.join(names)}."
        )


def _print_split(kept: Sequence[_Row]) -> None:
    """Prints the numbers of sequences for training and held out."""
    training = sum(row["split"] == "training" for row in kept)
    say(f"{training} sequences are for training, {len(kept) - training} held out.")


def _mean(values: Sequence[float]) -> float:
    """Returns the mean of one or more numbers."""
    return sum(values) / len(values)
