"""Fresh episodes by one program: its hundreds of single operations would be compiled one by one, in every module."""

import jax

from congrasp.actors import initial

sample = jax.jit(initial.sample, static_argnames=("hand", "task", "batch"))
"""`initial.sample`, compiled as in a rollout."""
