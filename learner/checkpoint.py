"""Complete checkpoints in one safetensors file each: a pytree's arrays by path, and JSON for the
rest.

A checkpoint is written to a temporary name, flushed and renamed, so that every file is complete
whenever the process or the machine dies. Its name contains its update, and a run resumes from the
newest intact one; the link `latest` is a convenience for users (a
file with the name, where the file system has no links).
"""

import contextlib
import itertools
import json
import os
import pathlib
import re
import zlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError, os_errors_as
from congrasp.common.io.files import sync_directory, write_atomically
from congrasp.common.io.inputs import open_file
from congrasp.common.io.opening import random_name
from congrasp.common.runtime import platforms
from congrasp.common.runtime.lazy_jax import jax, jnp
from congrasp.common.wire.codec import Message, decode, encode

KEPT = 3
"""Number of checkpoints kept for a run."""
_LATEST_LINK = "latest"
_META = "meta"
_PATTERN = "checkpoint_*.safetensors"
_NUMBER = re.compile(r"checkpoint_(\d{1,15})\.safetensors")
_ASIDE = ".aside"


class Checkpoints:
    """The newest `KEPT` checkpoints of a run."""

    def __init__(self, directory: pathlib.Path):
        """Uses `directory`, which the first `save` creates."""
        self._directory = directory

    def save(self, tree: Any, meta: dict[str, Any], version: int) -> pathlib.Path:
        """Writes a checkpoint, makes it the latest, and removes the oldest beyond `KEPT`.

        Args:
          tree: a pytree of arrays and integers.
          meta: anything JSON can hold.
          version: number of updates; part of the file's name.

        Raises:
          CongraspError: the disk is full; the previous checkpoints are intact.
        """
        path = self._directory / f"checkpoint_{version:09d}.safetensors"
        # As an array, since a header's length is limited
        text = np.frombuffer(json.dumps(meta).encode(), np.uint8)
        message = Message({**flatten(jax.device_get(tree)), _META: text}, {"version": version})
        write_atomically(path, encode(message))
        self._point_to(path)
        for old in self.files()[KEPT:]:
            if old != path:
                with contextlib.suppress(OSError):
                    old.unlink()
        return path

    def _point_to(self, path: pathlib.Path) -> None:
        """Makes `latest` a link to a checkpoint, or a file with its name where links do not exist.

        Nothing depends on it, so that a failure leaves it as it is.
        """
        latest = self._directory / _LATEST_LINK
        link = self._directory / random_name(_LATEST_LINK)
        try:
            link.symlink_to(path.name)
            platforms.replace(link, latest)
            sync_directory(self._directory)
        except OSError:
            with contextlib.suppress(OSError):
                link.unlink(missing_ok=True)
            with contextlib.suppress(CongraspError):
                write_atomically(latest, f"{path.name}\n".encode())

    def files(self) -> list[pathlib.Path]:
        """Files of the checkpoints, intact or not, the newest first."""
        files = [path for path in self._directory.glob(_PATTERN) if _update(path) >= 0]
        return sorted(files, key=_update)[::-1]

    def newest(self) -> int:
        """Update of the newest checkpoint, intact or not; -1 if there is none."""
        return max(map(_update, self.files()), default=-1)

    def load(
        self, template: Any, on_event: Callable[[str, str], None] = lambda level, text: None
    ) -> tuple[Any, dict[str, Any]]:
        """Loads the newest intact checkpoint: its tree, shaped like `template` (see `restore`), and
        its metadata.

        Raises:
          CongraspError: see `find`; or the checkpoint has another shape.
        """
        path, arrays, meta = self.find(on_event)
        return restore(arrays, template, str(path)), meta

    def find(
        self, on_event: Callable[[str, str], None]
    ) -> tuple[pathlib.Path, Mapping[str, Any], dict[str, Any]]:
        """Finds the newest intact checkpoint; returns its file, arrays and metadata.

        Newer damaged ones are renamed, so that training does not overwrite them when it reaches
        their update.

        Args:
          on_event: called with (level, text) for each damaged checkpoint and for the result.

        Raises:
          CongraspError: there is none, or a damaged one cannot be renamed.
        """
        damaged = []
        for path in self.files():
            try:
                arrays, meta = read_checkpoint(path)
            except CongraspError as error:
                damaged.append((path, str(error)))
                continue
            for other, why in damaged:
                renamed = set_aside(other)
                on_event(
                    "warning",
                    f"The checkpoint {other} is damaged: {why} It is ignored, and kept as "
                    f"{renamed.name}.",
                )
            on_event("info", f"Resuming from the checkpoint {path}.")
            return path, arrays, meta
        if damaged:
            raise CongraspError(
                f"No checkpoint in {self._directory} is intact; the newest, {damaged[0][0].name}, "
                f"is damaged: "
                f"{damaged[0][1]}",
                "Start again in another --run-dir.",
            )
        raise CongraspError(
            f"There is no checkpoint in {self._directory}.", "Start again in another --run-dir."
        )


def set_aside(path: pathlib.Path) -> pathlib.Path:
    """Renames a file to an unused name, so that its content is not overwritten; returns the path.

    Raises:
      CongraspError: it cannot be renamed.
    """
    others = (path.with_name(f"{path.name}{_ASIDE}{number or ''}") for number in itertools.count())
    target = next(other for other in others if not os.path.lexists(other))
    with os_errors_as(f"{path} cannot be renamed to {target.name}"):
        return platforms.replace(path, target)


def _update(path: pathlib.Path) -> int:
    """Update in a checkpoint's file name; -1 if there is none."""
    match = _NUMBER.fullmatch(path.name)
    if match is None:
        return -1
    return int(match[1])


def read_checkpoint(path: pathlib.Path) -> tuple[Mapping[str, Any], dict[str, Any]]:
    """Reads arrays and metadata of a checkpoint; raises a CongraspError with the reason if it is
    not intact.
    """
    with os_errors_as("It cannot be read"), open_file(path) as file:
        data = file.read()
    message = decode(data, max_bytes=len(data))
    if message.meta.get("version") != _update(path):
        raise CongraspError("The update in its header is not that in its file name.")
    try:
        meta = json.loads(message.arrays[_META].tobytes())
    except (KeyError, ValueError):
        meta = None
    if not isinstance(meta, dict):
        raise CongraspError("It lacks its metadata.")
    return message.arrays, meta


def checksum(tree: Any) -> int:
    """CRC-32 of the whole content of a checkpoint of the tree."""
    crc = 0
    for array in flatten(jax.device_get(tree)).values():
        crc = zlib.crc32(np.ascontiguousarray(array).tobytes(), crc)
    return crc


def flatten(tree: Any) -> dict[str, np.ndarray]:
    """Returns the leaves of a pytree as arrays, by their paths with slashes."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {
        jax.tree_util.keystr(path, simple=True, separator="/"): np.asarray(leaf)
        for path, leaf in leaves
    }


def restore(arrays: Mapping[str, Any], template: Any, source: str) -> Any:
    """Returns a tree like `template` from arrays by path, with their types; the inverse of
    `flatten`.

    A leaf becomes a JAX array on the default device, a NumPy array, or an integer, like that of the
    template.

    Raises:
      CongraspError: a leaf is missing or has another shape or type; the message names `source` and
        the first such leaf.
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(template)
    restored: list[Any] = []
    for path, leaf in leaves:
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        array = arrays.get(name)
        expected = np.asarray(leaf)
        if array is None or array.shape != expected.shape or array.dtype != expected.dtype:
            raise CongraspError(
                f"{source} does not match this run: '{name}' is missing or has another shape.",
                "Resume with the run's configuration and version of congrasp.",
            )
        if isinstance(leaf, jax.Array):
            # Not committed to a device, as after `init`, to avoid recompilation
            restored.append(jnp.array(array))
        elif isinstance(leaf, int):
            restored.append(int(array))
        else:
            restored.append(np.array(array))
    return jax.tree_util.tree_unflatten(structure, restored)
