"""Complete checkpoints: a pytree's arrays by path and JSON for the rest, in one safetensors file each.

A checkpoint is written beside its final name, flushed, renamed, and only then pointed at by the link `latest`; so
`latest` always names a whole file, whenever the process or the machine dies.
"""

import contextlib
import json
import os
import pathlib
import zlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from common.errors import CongraspError
from common.files import sync_directory, write_atomically
from common.wire.codec import Message, decode, encode

_LATEST = "latest"
_META = "meta"
_PATTERN = "checkpoint_*.safetensors"


class Checkpoints:
    """The checkpoints of one run, the newest of which are kept."""

    def __init__(self, directory: pathlib.Path, keep: int = 3):
        """Uses `directory`, which is made at the first `save`, for `keep` checkpoints."""
        self._directory, self._keep = directory, keep

    def save(self, tree: Any, meta: dict[str, Any], version: int) -> pathlib.Path:
        """Writes a checkpoint, makes it the latest, and removes the oldest beyond `keep`.

        Args:
          tree: a pytree of arrays and integers.
          meta: anything JSON can hold.
          version: number of updates, which names the file.

        Raises:
          CongraspError: if the disk is full; the previous checkpoints are intact.
        """
        path = self._directory / f"checkpoint_{version:09d}.safetensors"
        text = np.frombuffer(json.dumps(meta).encode(), np.uint8)  # as an array: a header's length is limited
        write_atomically(path, encode(Message({**flatten(jax.device_get(tree)), _META: text}, {"version": version})))
        link = self._directory / f".{_LATEST}.{os.getpid()}.tmp"
        try:
            link.unlink(missing_ok=True)
            link.symlink_to(path.name)
            link.replace(self._directory / _LATEST)
            sync_directory(self._directory)
        except OSError as error:
            raise CongraspError(f"{self._directory / _LATEST} could not be set: {error.strerror}.") from None
        for old in sorted(self._directory.glob(_PATTERN))[: -self._keep]:
            if old != path:
                with contextlib.suppress(OSError):
                    old.unlink()
        return path

    def load(self, template: Any) -> tuple[Any, dict[str, Any]]:
        """The latest checkpoint's tree, shaped as `template`, and its meta data.

        Raises:
          CongraspError: if there is none, or it is damaged or of another shape.
        """
        path = self._directory / _LATEST
        try:
            path = path.resolve(strict=True)
            data = path.read_bytes()
        except OSError:
            raise CongraspError(
                f"There is no checkpoint in {self._directory}.", "Start the run without --resume."
            ) from None
        try:
            arrays = decode(data, max_bytes=len(data)).arrays
        except CongraspError as error:
            raise CongraspError(
                f"The checkpoint {path} is damaged: {error}",
                f"Point {self._directory / _LATEST} at an older one to go on from there.",
            ) from None
        return restore(arrays, template, str(path)), json.loads(arrays[_META].tobytes())


def checksum(tree: Any) -> int:
    """CRC-32 of all that a checkpoint of the tree holds."""
    crc = 0
    for array in flatten(jax.device_get(tree)).values():
        crc = zlib.crc32(np.ascontiguousarray(array).tobytes(), crc)
    return crc


def flatten(tree: Any) -> dict[str, np.ndarray]:
    """The leaves of a pytree as arrays, by their path with slashes."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): np.asarray(leaf) for path, leaf in leaves}


def restore(arrays: Mapping[str, Any], template: Any, source: str) -> Any:
    """The inverse of `flatten`: a tree like `template`, whose leaves decide where each array goes.

    A JAX array goes to the default device, a NumPy array stays on the host, an integer becomes one.

    Raises:
      CongraspError: naming `source` and the first leaf that is missing or has another shape or type.
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(template)
    restored: list[Any] = []
    for path, leaf in leaves:
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        array, expected = arrays.get(name), np.asarray(leaf)
        if array is None or array.shape != expected.shape or array.dtype != expected.dtype:
            raise CongraspError(
                f"{source} does not fit this run: '{name}' is missing or of another shape.",
                "Resume with the configuration, and the version of congrasp, that the run was started with.",
            )
        if isinstance(leaf, jax.Array):
            restored.append(jnp.array(array))  # not bound to a device, as after `init`: nothing compiles again
        else:
            restored.append(int(array) if isinstance(leaf, int) else np.array(array))
    return jax.tree_util.tree_unflatten(structure, restored)
