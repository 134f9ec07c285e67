"""Settings that are arguments of compiled programs, registered as pytrees of JAX: other values need
no compilation. Their modules do without JAX, for command lines.
"""

import jax

from congrasp.common.task.config import RewardWeights
from congrasp.common.task.settings import ControlConfig

__all__ = ["ControlConfig", "RewardWeights"]

jax.tree_util.register_dataclass(RewardWeights)
jax.tree_util.register_dataclass(
    ControlConfig,
    data_fields=[
        "finger_scale",
        "wrist_position_scale",
        "wrist_rotation_scale",
        "guidance_position_limit",
        "approach_position_limit",
        "closing_position_limit",
        "closing_distance",
        "guidance_rotation_limit",
        "wrist_acceleration",
        "wrist_angular_acceleration",
        "hold_acceleration",
    ],
    meta_fields=["load_rate", "lookahead", "follow_object", "finger_guidance"],
)
