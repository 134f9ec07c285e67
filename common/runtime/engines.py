"""Registry of physics engines by name, used by command lines, configurations, evaluation and
errors.

`actors.physics` registers those of the project; another engine needs one more row.
"""

from collections.abc import Callable
from typing import Annotated, Any, Literal, NamedTuple

import tyro

from congrasp.common.errors import CongraspError


class Engine(NamedTuple):
    """Properties of an engine that are known before it is built."""

    make: Callable[..., Any]
    """(hand, task, objects, threads) -> `actors.physics.engine.Physics`; imports its dependencies
    when called.
    """
    batch: int
    """Default number of environments in an evaluation."""
    automatic: Callable[[str], bool] = lambda backend: False
    """JAX backend -> True if `auto` may select this engine there; the first such engine is used."""
    missing: Callable[[str], CongraspError | None] = lambda backend: None
    """JAX backend -> error that names what this machine lacks for the engine; None if it lacks
    nothing.
    """
    prepare: Callable[..., None] | None = None
    """(hand, task): begins in the background what the engine can build before there are objects, if
    there is any.
    """
    on_device: bool = False
    """True if rollouts stay on the learner's device, so that by default one actor runs in the
    learner's process.
    """
    title: str = ""
    """Display name; that of the row if empty."""


ENGINES: dict[str, Engine] = {}
"""Engines by name; `--physics` accepts these and `auto`."""


def engine_title(name: str) -> str:
    """Display name of an engine."""
    return (name in ENGINES and ENGINES[name].title) or name


PhysicsName = Annotated[
    str,
    tyro.conf.arg(
        constructor_factory=lambda: Literal.__getitem__(("auto", *ENGINES))  # type: ignore[attr-defined]
    ),
]
"""`auto` or a key of `ENGINES`; a command line offers those registered when it is parsed."""
