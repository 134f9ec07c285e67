"""A joint's path in a BVH file."""

import pathlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_file

MAX_BYTES = 32 << 20
"""Limit of a file's size."""
_MAX_DEPTH = 200
"""Largest number of joints in a chain."""


class _Link(NamedTuple):
    """A joint between the root and the requested joint."""

    offset: np.ndarray
    """(3,) position in the frame of its parent, in the file's unit."""
    channels: list[str]
    """Names of its degrees of freedom."""
    first: int
    """Column of its first channel."""


class _Skeleton(NamedTuple):
    """Joints of a file, as far as they determine the pose of one of them."""

    chain: list[_Link] | None
    """From the root to the requested joint; None if there is no such joint."""
    columns: int
    """Number of channels of all joints."""
    names: list[str]
    """Names of all joints."""


def read_bvh(path: pathlib.Path, joint: str) -> tuple[np.ndarray, Rotation, float]:
    """Positions (T, 3) and orientations of a joint in the unit and axes of a BVH file, and seconds
    between frames.

    Raises:
      CongraspError: the file is damaged, or has no such joint; the message names the existing ones.
    """
    try:
        text = read_file(path, MAX_BYTES, "Cut it into shorter ones.").decode()
        return _joint_path(text, path, joint)
    except (ValueError, LookupError, StopIteration) as error:
        raise CongraspError(
            f"{path} cannot be read as BVH: {str(error)[:200] or 'it was cut'}.", "Export it again."
        ) from None


def _joint_path(text: str, path: pathlib.Path, joint: str) -> tuple[np.ndarray, Rotation, float]:
    """Does the work of `read_bvh` for a file's text.

    Raises:
      CongraspError: there is no such joint.
      ValueError, LookupError, StopIteration: the file is damaged.
    """
    head, _, tail = text.partition("MOTION")
    skeleton = _skeleton(head, joint)
    if skeleton.chain is None:
        raise CongraspError(
            f"{path} has no joint {ascii(joint)[:60]}.",
            f"Choose from its joints: {', '.join(skeleton.names)[:2000]}.",
        )
    _, count, *_, seconds, numbers = tail.split(maxsplit=5)
    rows = np.array(numbers.split(), float).reshape(int(count), skeleton.columns)
    if not (np.isfinite(rows).all() and 0.0 < float(seconds) <= 1.0):
        raise ValueError(
            "it contains numbers that are not finite, or its frames last more than a second"
        )
    position = np.zeros((len(rows), 3))
    rotation = Rotation.identity(len(rows))
    for link in skeleton.chain:
        moved, turn = _link_motion(link, rows)
        position = position + rotation.apply(moved)
        rotation = rotation * turn
    return position, rotation, float(seconds)


def _link_motion(link: _Link, rows: np.ndarray) -> tuple[np.ndarray, Rotation]:
    """Positions (T, 3) and orientations of a joint in the frame of its parent."""
    values = rows[:, link.first : link.first + len(link.channels)]
    moved = np.tile(link.offset, (len(rows), 1))
    turn = Rotation.identity(len(rows))
    for channel, column in zip(link.channels, values.T, strict=True):
        axis = channel[0].upper()
        kind = channel[1:].lower()
        if kind == "position":
            # A position replaces the offset, as in most programs.
            moved[:, "XYZ".index(axis)] = column
        elif kind == "rotation":
            turn = turn * Rotation.from_euler(axis, column[:, None], degrees=True)
        else:
            raise ValueError(f"it has the channel {channel[:30]}")
    return moved, turn


def _skeleton(text: str, joint: str) -> _Skeleton:
    """Reads the hierarchy of a file."""
    tokens = iter(text.split())
    stack: list[_Link] = []
    chain: list[_Link] | None = None
    names: list[str] = []
    columns = 0
    name = ""
    for token in tokens:
        if token in ("ROOT", "JOINT"):
            name = next(tokens)
            names.append(name)
        elif token == "End":
            name = ""
        elif token == "{":
            stack.append(_Link(np.zeros(3), [], columns))
            if len(stack) > _MAX_DEPTH:
                raise ValueError(f"its joints are nested deeper than {_MAX_DEPTH}")
        elif token == "}":
            stack.pop()
        elif token == "OFFSET":
            stack[-1] = stack[-1]._replace(offset=_offset(tokens))
        elif token == "CHANNELS":
            channels = _channels(tokens)
            stack[-1] = stack[-1]._replace(channels=channels, first=columns)
            columns += len(channels)
        if name == joint and token in ("OFFSET", "CHANNELS"):
            chain = list(stack)
    return _Skeleton(chain, columns, names)


def _offset(tokens: Iterator[str]) -> np.ndarray:
    """The next three numbers."""
    return np.array([float(next(tokens)) for _ in range(3)])


def _channels(tokens: Iterator[str]) -> list[str]:
    """The next channels, after their number."""
    count = int(next(tokens))
    return [next(tokens) for _ in range(count)]
