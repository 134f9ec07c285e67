"""One of two ranks that steps an environment in warp; says on whose devices it lies. Arguments: rank, port."""

import sys

import jax
import jax.numpy as jnp
import warp

from congrasp.actors.physics.engine import ResetState
from congrasp.actors.physics.warp import WarpPhysics
from congrasp.common.hands import get_hand
from congrasp.common.objects import procedural
from congrasp.common.task.config import TaskConfig
from congrasp.learner.distributed.ranks import Ranks


def main() -> None:
    warp.config.optimization_level = 0  # as in conftest.py, so that the kernels are those of the other tests
    rank, port = sys.argv[1:]
    ranks = Ranks.join(int(rank), 2, f"127.0.0.1:{port}")
    hand = get_hand("human")
    physics = WarpPhysics(hand, TaskConfig(), [procedural.generate(0, "box")])
    one, zero, level = jnp.ones(1), jnp.zeros((1, 3)), jnp.array([[1.0, 0.0, 0.0, 0.0]])
    fingers = jnp.zeros((1, len(hand.joints)))
    index = jnp.zeros(1, int)
    state = physics.start(
        ResetState(index, one, one, one, zero, level, jnp.zeros((1, 6)), fingers, zero, level, index > 0)
    )
    state, after = physics.step(state, jnp.zeros((1, 6 + len(hand.joints))), index == 0)
    leaves = [leaf for leaf in jax.tree.leaves((state, after)) if isinstance(leaf, jax.Array)]
    print(sorted({device.process_index for leaf in leaves for device in leaf.devices()}), len(leaves) > 20)
    ranks.exchange({})
    ranks.close()


if __name__ == "__main__":
    main()
