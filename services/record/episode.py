"""Content of an episode's message: its constraints and phases, and the arm that carries the hand.

The arm has joints, frames of the links, and their meshes with colours.

Quaternions are (w, x, y, z) and rotate a link's frame into the world. T frames, N joints, A links,
M meshes, V vertices, E triangles.
"""

import dataclasses
import functools
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, NamedTuple, get_type_hints

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.arrays import check_arrays
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.constraints.markers import Marker
from congrasp.common.wire.codec import Message

_LATEST = 1e4  # s
_OLDER = ("affordance", "pose_finger", "pose_wrist", "trajectory")
"""Default blocks of the `goal/mask` of recordings without names."""
UNLIMITED = 1e3
"""Limit of joints without limits, rad or m."""
_PREFIX = "arm_"
_FOLDER, _META = "arm/", "arm"  # of the arrays, and of name and texts, in an episode's message
_INDICES = {
    "joint_link": "A",
    "link_parent": "A",
    "hand_link": "A",
    "mesh_link": "A",
    "mesh_faces": "V",
    "face_mesh": "M",
}


def active_blocks(arrays: Mapping[str, np.ndarray]) -> dict[str, bool]:
    """Activity of each block of the observation, by name."""
    if "goal/mask" in arrays:
        return dict(zip(_OLDER, (np.asarray(arrays["goal/mask"]) > 0).tolist(), strict=True))
    found = {
        name.removeprefix("active/"): value
        for name, value in arrays.items()
        if name.startswith("active/")
    }
    return {name: bool(np.asarray(value)) for name, value in found.items()}


def active_constraints(arrays: Mapping[str, np.ndarray]) -> tuple[str, ...]:
    """Names of the active constraints, weakest first; the heading is always included."""
    blocks = active_blocks(arrays)
    return tuple(
        c.name
        for c in CONSTRAINTS
        if not c.optional or any(blocks.get(block) for block in c.blocks)
    )


def markers(arrays: Mapping[str, np.ndarray]) -> Iterator[tuple[str, Marker]]:
    """Yields the markers of each active constraint, with its name."""
    blocks = [name for name, active in active_blocks(arrays).items() if active]
    for constraint in CONSTRAINTS:
        if not constraint.optional or set(constraint.blocks) & set(blocks):
            own = constraint.goal(
                *(arrays[f"goal/{constraint.name}_{field}"] for field in constraint.arrays)
            )
            yield from ((constraint.name, marker) for marker in constraint.markers(own, blocks))


def grasp_span(meta: Mapping[str, Any], control_dt: float, table: np.ndarray) -> tuple[int, int]:
    """First step of the grasp, and first step after it: that of the lift, or without the table.

    Args:
      meta: metadata of the episode or motion.
      control_dt: length of a control step, s.
      table: (T,) bool, True where the table is present.
    """
    phases, steps = phases_of(meta), len(table)
    end = round(min(phases["lift"] / control_dt, steps)) if "lift" in phases else int(np.sum(table))
    return min(round(min(phases.get("grasp", 0.0) / control_dt, steps)), end), end


def phases_of(meta: Mapping[str, Any]) -> dict[str, float]:
    """Start times of the phases of an episode or a motion (approach, grasp, lift, hold), s, without
    invalid times.
    """
    found = meta.get("phases")
    times = found.items() if isinstance(found, dict) else ()
    return {
        str(name): float(time)
        for name, time in times
        if isinstance(time, int | float) and 0 <= time < _LATEST
    }


class Mesh(NamedTuple):
    """The part of a link that has one colour."""

    link: int
    colour: tuple[float, float, float]
    """sRGB from 0 to 1."""
    vertices: np.ndarray
    """(v, 3) m, link frame."""
    faces: np.ndarray
    """(e, 3) indices of vertices."""


@dataclasses.dataclass(frozen=True, eq=False)
class MovedArm:
    """An arm of N joints from its base to the link that carries the hand."""

    name: str
    """Name of the arm."""
    joint_names: Annotated[np.ndarray, "(N,) text"]
    joint_position: Annotated[
        np.ndarray, "(T, N) rad, or m of slides, in the order of arm_joint_names"
    ]
    joint_slides: Annotated[np.ndarray, "(N,) bool, whether a joint is a slide"]
    joint_link: Annotated[
        np.ndarray, "(N,) the link that a joint moves; joints of one link act in this order"
    ]
    joint_axis: Annotated[np.ndarray, "(N, 3) unit, link frame"]
    joint_anchor: Annotated[np.ndarray, "(N, 3) m, link frame"]
    joint_limits: Annotated[
        np.ndarray, "(N, 2) rad or m, lower and upper; -1000 and 1000 without limits"
    ]
    joint_speed: Annotated[np.ndarray, "(N,) rad/s or m/s, largest speed"]
    link_names: Annotated[np.ndarray, "(A,) text, the base first"]
    link_parent: Annotated[np.ndarray, "(A,) index of the link that carries it, -1 for the base"]
    link_position: Annotated[np.ndarray, "(T, A, 3) m, world"]
    link_quaternion: Annotated[np.ndarray, "(T, A, 4) w x y z, link frame to world"]
    hand_link: Annotated[np.ndarray, "() index of the link that carries the hand"]
    hand_position: Annotated[np.ndarray, "(3,) m, the hand's wrist frame in that link's"]
    hand_quaternion: Annotated[np.ndarray, "(4,) w x y z, the hand's wrist frame to that link's"]
    mesh_link: Annotated[np.ndarray, "(M,) link of each mesh"]
    mesh_colour: Annotated[np.ndarray, "(M, 3) sRGB from 0 to 1"]
    mesh_vertices: Annotated[np.ndarray, "(V, 3) m, frame of the mesh's link"]
    mesh_faces: Annotated[np.ndarray, "(E, 3) indices of arm_mesh_vertices"]
    face_mesh: Annotated[np.ndarray, "(E,) mesh of each triangle"]

    @functools.cached_property
    def meshes(self) -> tuple[Mesh, ...]:
        """Meshes with triangles, in their order."""
        found = []
        for m, (link, colour) in enumerate(
            zip(self.mesh_link.tolist(), self.mesh_colour.tolist(), strict=True)
        ):
            used, faces = np.unique(self.mesh_faces[self.face_mesh == m], return_inverse=True)
            if len(used):
                found.append(
                    Mesh(link, tuple(colour), self.mesh_vertices[used], faces.reshape(-1, 3))
                )
        return tuple(found)

    def at(self, frames: np.ndarray) -> "MovedArm":
        """Returns the arm in other frames (n,) of the motion."""
        return dataclasses.replace(self, **{name: getattr(self, name)[frames] for name in _TIMED})

    def recorded(self, episode: Message) -> Message:
        """Returns an episode with the arm."""
        numbers = {
            f"{_FOLDER}{name}": values
            for name, values in self.arrays().items()
            if values.dtype.kind != "U"
        }
        texts = {
            name: values.tolist()
            for name, values in self.arrays().items()
            if values.dtype.kind == "U"
        }
        return Message(
            {**episode.arrays, **numbers}, {**episode.meta, _META: {"name": self.name, **texts}}
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns the arrays by the names that they have in files."""
        return {name: getattr(self, name.removeprefix(_PREFIX)) for name in ARM_ARRAYS}


_HINTS = get_type_hints(MovedArm, include_extras=True)
ARM_ARRAYS = {
    f"{_PREFIX}{name}": hint.__metadata__[0] for name, hint in _HINTS.items() if name != "name"
}
"""Meaning of each array in files, with its shape."""
_TIMED = [
    name.removeprefix(_PREFIX) for name, meaning in ARM_ARRAYS.items() if meaning.startswith("(T,")
]


def arm_of(name: str, arrays: Mapping[str, np.ndarray], frames: int) -> MovedArm:
    """Returns the arm whose arrays a file holds.

    Args:
      name: its name.
      arrays: by their names in files.
      frames: T of the motion.

    Raises:
      ValueError, KeyError: an array is missing, or does not match its meaning.
    """
    sizes = check_arrays(
        arrays,
        ARM_ARRAYS,
        indices=tuple(f"{_PREFIX}{name}" for name in _INDICES),
        largest=1e6,
        sizes={"T": frames},
    )
    arm = MovedArm(name, **{key.removeprefix(_PREFIX): arrays[key] for key in ARM_ARRAYS})
    for key, letter in _INDICES.items():
        values = getattr(arm, key)
        if values.min() < -(key == "link_parent") or values.max() >= sizes[letter]:
            raise ValueError(f"{_PREFIX}{key} has indices that do not exist")
    if (arm.link_parent >= np.arange(sizes["A"])).any():
        raise ValueError(f"{_PREFIX}link_parent has links before the one that carries them")
    return arm


def arm_of_episode(episode: Message) -> MovedArm | None:
    """Returns the arm of an episode, if there is one.

    Raises:
      CongraspError: its arrays do not match their meanings.
    """
    if _META not in episode.meta:
        return None
    try:
        texts = dict(episode.meta[_META])
        name = str(texts.pop("name"))
        # Writable
        own = {
            key: np.array(value) for key, value in episode.arrays.items() if key.startswith(_FOLDER)
        }
        arrays = {key.removeprefix(_FOLDER): value for key, value in own.items()}
        arrays |= {key: np.array(value, str) for key, value in texts.items()}
        return arm_of(name, arrays, len(episode.arrays["table"]))
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise CongraspError(f"The episode's arm is not valid ({str(error)[:200]}).") from None
