"""Named configurations to start from; every field can be overridden on the command line."""

from common.config import NetworkConfig, ObjectsConfig, PPOConfig, RunConfig, TaskConfig
from common.errors import CongraspError

PRESETS = {
    # Minutes on two CPU cores. Easier than the full task: small compact objects, approaches from above only, and the
    # heading as the only constraint.
    "quickstart": RunConfig(
        name="quickstart",
        environments=64,
        updates=50,
        physics="native",
        task=TaskConfig(headings="above", p_affordance=0.0, p_pose=0.0, p_trajectory=0.0),
        objects=ObjectsConfig(count=16),
        network=NetworkConfig(hidden=(256, 128)),
        ppo=PPOConfig(minibatches=8),
    ),
    # The full task of the paper for the human hand, sized for a GPU.
    "human": RunConfig(name="human", environments=4096, updates=400, objects=ObjectsConfig(count=64)),
}


def get_preset(name: str) -> RunConfig:
    """The preset of this name; a CongraspError lists those that exist."""
    if name not in PRESETS:
        raise CongraspError(f"There is no preset '{name}'.", f"Choose one of: {', '.join(PRESETS)}.")
    return PRESETS[name]
