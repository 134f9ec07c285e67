"""Motions of a studio, to play, compare and save."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.common.task.constraints import get_constraint
from congrasp.common.wire.codec import Message
from congrasp.services.record.goals import active_constraints

_ABOVE = np.cos(np.radians(45.0))
MOST = 30
"""Number of motions kept; the oldest is dropped first."""


class Motions:
    """The newest motions, by number."""

    def __init__(self) -> None:
        """Begins without motions."""
        self._kept: dict[str, Message] = {}
        self._number = 0

    def keep(self, episode: Message) -> str:
        """Keeps a motion; returns its number."""
        self._number += 1
        self._kept[str(self._number)] = episode
        while len(self._kept) > MOST:
            del self._kept[next(iter(self._kept))]
        return str(self._number)

    def get(self, key: str) -> Message:
        """A motion by its number; a CongraspError if there is none."""
        if key not in self._kept:
            raise CongraspError(f"There is no motion '{key[:60]}'.", "Press Grasp, or choose one of the list.")
        return self._kept[key]

    def delete(self, key: str) -> None:
        """Deletes a motion, if there is one of this number."""
        self._kept.pop(key, None)

    def view(self) -> list[dict[str, Any]]:
        """List entries of the motions, the newest first."""
        return [_described(key, episode) for key, episode in self._kept.items()][::-1]


def _asked(episode: Message) -> str:
    """Request of a motion in words: its constraints, and the direction of the approach, world frame."""
    arrays, names = episode.arrays, active_constraints(episode.arrays)[1:]
    turn = Rotation.from_quat(arrays["object_quaternion"][0], scalar_first=True)
    down = -float(turn.apply(np.asarray(arrays["goal/heading_direction"], float))[2])
    way = "from above" if down > _ABOVE else "from below" if down < -_ABOVE else "from the side"
    return ", ".join([*(get_constraint(name).title for name in names), way])


def _described(key: str, episode: Message) -> dict[str, Any]:
    """List entry of a motion."""
    meta, metrics = episode.meta, episode.meta.get("metrics", {})
    return {
        "id": key,
        "object": meta["object"],
        "asked": _asked(episode),
        "success": bool(meta["success"]),
        "held": bool(metrics.get("held", 0.0) > 0),
        "note": meta.get("note", ""),
        "version": meta.get("version"),
        "steps": len(episode.arrays["table"]),
        "metrics": {name: float(value) for name, value in metrics.items() if np.isfinite(value)},
    }
