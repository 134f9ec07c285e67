"""Metadata of exported files."""

from typing import Any

from congrasp.common.episode.episode import Episode


def facts(motion: Episode, *, frame: str, unit: str, quaternion: str) -> dict[str, Any]:
    """Metadata of every file: origin of the motion, and meaning of its numbers in this format."""
    about = {
        "generator": "congrasp",
        "hand": motion.hand,
        "object": motion.object,
        "success": motion.success,
        "constraints": list(motion.constraints),
        "control_dt": motion.control_dt,
        "frame": frame,
        "unit": unit,
        "quaternion": quaternion,
        "joints": motion.joint_names.tolist(),
        "links": motion.link_names.tolist(),
    }
    arm = motion.arm
    if arm is not None:
        about["arm"] = arm.name
        about["arm_joints"] = arm.joint_names.tolist()
        about["arm_links"] = arm.link_names.tolist()
    return about
