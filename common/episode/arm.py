"""The arm that carries the hand: its joints, the frames of its links, and their meshes.

Quaternions are (w, x, y, z) and rotate a link's frame into the world. T frames, N joints, A links,
M meshes, V vertices, E triangles.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Annotated, NamedTuple, get_type_hints

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.arrays import check_arrays
from congrasp.common.wire.codec import Message

UNLIMITED = 1e3
"""Limit of joints without limits, rad or m."""
_FILE_PREFIX = "arm_"
"""Prefix of the arm's arrays in motion files."""
_MESSAGE_FOLDER = "arm/"
"""Folder of the arm's arrays in messages, whose names have the prefix of files, too."""
ARM_META = "arm"
"""Entry of a message's metadata with the arm's name and its arrays of texts."""
_LARGEST = 1e6
"""Bound of the numbers of an arm."""
_INDICES = {
    "joint_link": "A",
    "link_parent": "A",
    "hand_link": "A",
    "mesh_link": "A",
    "mesh_faces": "V",
    "face_mesh": "M",
}
"""Fields of indices, with the size of what they index."""


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
    joint_slides: Annotated[np.ndarray, "(N,) bool, True for prismatic joints"]
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
        meshes = []
        for number, link in enumerate(self.mesh_link.tolist()):
            faces_of_mesh = self.mesh_faces[self.face_mesh == number]
            used, faces = np.unique(faces_of_mesh, return_inverse=True)
            if not len(used):
                continue
            colour = tuple(self.mesh_colour[number].tolist())
            meshes.append(Mesh(link, colour, self.mesh_vertices[used], faces.reshape(-1, 3)))
        return tuple(meshes)

    def at_frames(self, frames: np.ndarray) -> "MovedArm":
        """Returns the arm in other frames (n,) of the motion."""
        moved = {name: getattr(self, name)[frames] for name in _TIMED}
        return dataclasses.replace(self, **moved)

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns the arrays by their names in motion files."""
        return {name: getattr(self, name.removeprefix(_FILE_PREFIX)) for name in ARM_ARRAYS}

    def add_to(self, message: Message) -> Message:
        """Returns the message of an episode with the arm."""
        numbers = {}
        texts = {}
        for name, values in self.arrays().items():
            if values.dtype.kind == "U":
                texts[name] = values.tolist()
            else:
                numbers[f"{_MESSAGE_FOLDER}{name}"] = values
        meta = {**message.meta, ARM_META: {"name": self.name, **texts}}
        return Message({**message.arrays, **numbers}, meta)


def _meanings() -> dict[str, str]:
    """Meaning of each array of an arm, by its name in motion files."""
    meanings = {}
    for name, hint in get_type_hints(MovedArm, include_extras=True).items():
        if name != "name":
            meanings[f"{_FILE_PREFIX}{name}"] = hint.__metadata__[0]
    return meanings


ARM_ARRAYS = _meanings()
"""Meaning of each array in motion files, with its shape."""
_TIMED = [
    name.removeprefix(_FILE_PREFIX)
    for name, meaning in ARM_ARRAYS.items()
    if meaning.startswith("(T,")
]
"""Fields with a value for each frame."""


def arm_of_arrays(name: str, arrays: Mapping[str, np.ndarray], frames: int) -> MovedArm:
    """Returns the arm whose arrays a motion file holds.

    Args:
      name: its name.
      arrays: by their names in motion files.
      frames: T of the motion.

    Raises:
      ValueError, KeyError: an array is missing, or does not match its meaning.
    """
    sizes = check_arrays(
        arrays,
        ARM_ARRAYS,
        indices=tuple(f"{_FILE_PREFIX}{field}" for field in _INDICES),
        largest=_LARGEST,
        sizes={"T": frames},
    )
    fields = {key.removeprefix(_FILE_PREFIX): arrays[key] for key in ARM_ARRAYS}
    arm = MovedArm(name, **fields)
    _check_indices(arm, sizes)
    return arm


def _check_indices(arm: MovedArm, sizes: Mapping[str, int]) -> None:
    """Raises a ValueError for indices of links, vertices or meshes that do not exist."""
    for field, size in _INDICES.items():
        values = getattr(arm, field)
        least = -1 if field == "link_parent" else 0
        if values.min() < least or values.max() >= sizes[size]:
            raise ValueError(f"{_FILE_PREFIX}{field} has indices that do not exist")
    if (arm.link_parent >= np.arange(sizes["A"])).any():
        raise ValueError(f"{_FILE_PREFIX}link_parent has links before the one that carries them")


def arm_of_message(message: Message) -> MovedArm | None:
    """Returns the arm in an episode's message, if there is one.

    Raises:
      CongraspError: its arrays do not match their meanings.
    """
    if ARM_META not in message.meta:
        return None
    try:
        texts = dict(message.meta[ARM_META])
        name = str(texts.pop("name"))
        arrays = _writable_arrays(message)
        for key, words in texts.items():
            arrays[key] = np.array(words, str)
        return arm_of_arrays(name, arrays, len(message.arrays["table"]))
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise CongraspError(f"The episode's arm is not valid ({str(error)[:200]}).") from None


def _writable_arrays(message: Message) -> dict[str, np.ndarray]:
    """Copies the arrays of numbers of the arm in a message, by their names in motion files."""
    arrays = {}
    for key, values in message.arrays.items():
        if key.startswith(_MESSAGE_FOLDER):
            arrays[key.removeprefix(_MESSAGE_FOLDER)] = np.array(values)
    return arrays
