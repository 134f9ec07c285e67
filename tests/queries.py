"""Queries as clients pack them."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from congrasp.common.wire.codec import Message
from congrasp.services.client.packer import Packer
from congrasp.services.serve.requests import Layout

_POINTS = ("cloud", "surface_points", "surface_avoid", "surface_normals", "camera_position")


def packed(
    layout: Layout, fields: Mapping[str, Any], constraints: Sequence[str] = ("heading",)
) -> Message:
    """The query of one state, whose points and goals are those of its episode."""
    rest = {name: np.asarray(value) for name, value in fields.items()}
    episode = {name: rest.pop(name) for name in _POINTS if name in rest}
    goals: dict[str, dict[str, np.ndarray]] = {}
    for name in constraints:
        prefix = f"{name}_"
        of_constraint = [field for field in rest if field.startswith(prefix)]
        goals[name] = {field.removeprefix(prefix): rest.pop(field) for field in of_constraint}
    return Packer({**layout.description(), "digest": layout.digest}, episode, goals).pack([rest])
