"""Wrist speed over time of grasps with a reach, and the range of human reaches: one sheet and its
figures.
"""

import pathlib
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import find_peaks

from congrasp.common.episode.episode import Episode
from congrasp.common.episode.motion_file import load_motion
from congrasp.common.errors import CongraspError
from congrasp.services.grasp.files import MOTION
from congrasp.services.viz.plots import COLOURS, QUIET, new_figure, save, style

SHARE = (0.3, 0.4)
SPEED = (0.5, 1.2)
"""Share of the movement's time at which human reaches of some 40 cm are fastest, and m/s."""
_STILL = 0.05  # m/s below which the wrist has arrived
_PROMINENT = 0.05  # m/s by which the speed falls on both sides of a peak
_COLUMNS = 4


class Profile(NamedTuple):
    """A reach with its grasp, up to the lift or the table's removal."""

    speed: np.ndarray
    """(T,) m/s, of the wrist."""
    dt: float
    handover: float
    """s, at which the policy takes over."""
    arrival: float
    """s, at which the wrist is first slow after its peak."""
    way: float
    """m, to the arrival."""
    peaks: int

    @property
    def peak(self) -> float:
        """Greatest speed, m/s."""
        return float(self.speed.max())

    @property
    def at(self) -> float:
        """Share of the time to the arrival at which the wrist is fastest."""
        return float(self.speed.argmax() * self.dt / self.arrival)

    @property
    def after(self) -> float:
        """Greatest speed after the policy has taken over, m/s."""
        return float(self.speed[round(self.handover / self.dt) :].max())


def profile(motion: Episode) -> Profile:
    """The profile of a motion, which has a reach."""
    phases = motion.about["phases"]
    dt = motion.control_dt
    if "approach" not in phases:
        raise CongraspError(f"The grasp of '{motion.object}' has no reach.", "Set --approach.")
    end = round(phases.get("lift", phases["hold"]) / dt)
    steps = np.linalg.norm(np.diff(motion.wrist_position[: end + 1].astype(float), axis=0), axis=1)
    speed = steps / dt
    slow = np.flatnonzero(speed[speed.argmax() :] < _STILL)
    arrival = int(speed.argmax() + slow[0]) if len(slow) else len(speed)
    peaks, _ = find_peaks(np.append(0.0, speed[:arrival]), prominence=_PROMINENT)
    return Profile(
        speed, dt, phases["grasp"], arrival * dt, float(steps[:arrival].sum()), len(peaks)
    )


def speeds(
    grasps: pathlib.Path = pathlib.Path("runs/gallery"),
    out: pathlib.Path = pathlib.Path("docs/notes/speeds.png"),
    count: int = 12,
) -> int:
    """Wrist speed of the gallery's grasps over time, with the range of human reaches, as one sheet.

    Args:
      grasps: Folder of the gallery's grasps.
      out: The picture.
      count: Number of grasps, by the order of their names.

    Examples:
      python -m tests.benchmarks speeds
      python -m tests.benchmarks speeds --grasps runs/gallery --out speeds.svg
    """
    files = sorted(grasps.glob(f"*/*/{MOTION}"))[:count]
    if not files:
        raise CongraspError(
            f"There is no {MOTION} in the folders of {grasps}.", "Run the gallery first."
        )
    profiles = {file.parent.parent.name: profile(load_motion(file)) for file in files}
    rows = -(-len(profiles) // _COLUMNS)
    figure = new_figure(
        12,
        2.3 * rows + 0.6,
        "Wrist speed from the start of the reach to the lift; human reaches green",
    )
    for i, (name, one) in enumerate(profiles.items(), 1):
        _draw(figure.add_subplot(rows, _COLUMNS, i), name, one)
    save(figure, out.with_suffix(""), [out.suffix[1:]])
    print(
        "| grasp | way | peak | at | peaks | after the handover | arrival "
        "|\n|---|---|---|---|---|---|---|"
    )
    for name, one in profiles.items():
        print(
            f"| {name} | {one.way:.2f} m | {one.peak:.2f} m/s | {100 * one.at:.0f} % | {one.peaks} "
            f"| "
            f"{one.after:.2f} m/s | {one.arrival:.2f} s |"
        )
    return 0


def _draw(axes: Any, name: str, one: Profile) -> None:
    """One panel: speed, handover and the human range."""
    style(axes, f"{name}: {one.peak:.2f} m/s at {100 * one.at:.0f} %", "s", "m/s")
    low, high = (share * one.arrival for share in SHARE)
    axes.fill_between([low, high], *SPEED, color=COLOURS[2], alpha=0.25, linewidth=0)
    axes.plot(np.arange(len(one.speed)) * one.dt, one.speed, color=COLOURS[0])
    axes.axvline(one.handover, color=QUIET, linestyle=":", linewidth=1)
    axes.set_ylim(0.0, 1.25)
