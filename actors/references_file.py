"""File that preserves an actor's reference poses across restarts."""

import contextlib
import hashlib
import pathlib

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.io.files import read_kept, write_atomically
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.sampling.closed_poses import Poses
from congrasp.common.task.sampling.references import reference_columns
from congrasp.common.wire.codec import Message, encode

_POSES = ("pose_q", "pose_position", "pose_quaternion")
"""Columns of the bank in the file."""


def references_file(run_dir: pathlib.Path, actor: str) -> pathlib.Path:
    """Path of an actor's references in a run directory."""
    return run_dir / "references" / f"{actor}.safetensors"


def save_references(path: pathlib.Path, bank: ConstraintBank) -> None:
    """Writes the bank's references for a restarted actor; a full disk is ignored, and the next
    start lacks them.

    They are collected over hundreds of updates. Without them, the goals of a restarted actor are
    less feasible: a run on one H200 that was resumed at update 993 fell from 68 to 60 % of
    reference poses held, and took 250 updates to recover. The file has the poses in half precision,
    3 MB for 1,600 objects; trajectories to them are drawn again.
    """
    arrays = {name: np.asarray(getattr(bank, name), np.float16) for name in _POSES}
    arrays["grasps"] = np.asarray(bank.grasps)
    with contextlib.suppress(CongraspError, OSError):
        write_atomically(path, encode(Message(arrays, {"objects": _digest(bank)})))


def with_saved_references(
    path: pathlib.Path, hand: Hand, task: TaskConfig, bank: ConstraintBank
) -> ConstraintBank:
    """Returns the bank with the references of a file; unchanged if the file is missing, damaged or
    of other objects.
    """
    message = read_kept(path)
    if message is None or message.meta.get("objects") != _digest(bank):
        return bank
    if message.arrays.keys() != {*_POSES, "grasps"}:
        return bank
    for name, array in message.arrays.items():
        if array.shape != getattr(bank, name).shape:
            return bank
    poses = Poses(*(jnp.asarray(message.arrays[name], jnp.float32) for name in _POSES))
    norm = jnp.linalg.norm(poses.quaternion, axis=-1, keepdims=True)
    poses = poses._replace(quaternion=poses.quaternion / norm)
    columns = reference_columns(
        hand, poses, bank.rest, jax.random.key(0), task.trajectory_points, task.human_paths
    )
    return bank._replace(grasps=jnp.asarray(message.arrays["grasps"]), **columns)


def _digest(bank: ConstraintBank) -> str:
    """Digest of the objects of a bank, their resting poses and their order."""
    digest = hashlib.sha256()
    for array in (bank.points, bank.rest):
        digest.update(np.ascontiguousarray(array, np.float32).tobytes())
    return digest.hexdigest()
