"""One of two ranks that steps an environment in warp; says on whose devices it lies. Arguments:
rank, port.
"""

import sys

import jax
import jax.numpy as jnp

from congrasp.common.objects import procedural
from congrasp.learner.distributed.ranks import Ranks
from tests.task import HAND, start_of, warp_engine


def main() -> None:
    rank, port = sys.argv[1:]
    ranks = Ranks.join(int(rank), 2, f"127.0.0.1:{port}")
    physics = warp_engine([procedural.generate(0, "box")])
    state = physics.start(jax.tree.map(jnp.asarray, start_of()))
    state, after = physics.step(state, jnp.zeros((1, 6 + len(HAND.joints))), jnp.ones(1, bool))
    leaves = [leaf for leaf in jax.tree.leaves((state, after)) if isinstance(leaf, jax.Array)]
    devices = set().union(*(leaf.devices() for leaf in leaves))
    print(sorted({device.process_index for device in devices}), len(leaves) > 20)
    ranks.exchange({})
    ranks.close()


if __name__ == "__main__":
    main()
