"""Physics engines by name: the one table from which command lines, configurations, evaluation and errors take them.

`actors.physics` registers those of the project; another is added by one more row.
"""

from collections.abc import Callable
from typing import Annotated, Any, Literal, NamedTuple

import tyro

from congrasp.common.errors import CongraspError


class Engine(NamedTuple):
    """What is known of an engine before it is built."""

    make: Callable[..., Any]
    """(hand, task, objects, threads) -> `actors.physics.engine.Physics`; imports what it needs when it is called."""
    batch: int
    """Environments side by side in an evaluation, where nobody names a number."""
    automatic: Callable[[str], bool] = lambda backend: False
    """JAX backend -> whether `auto` takes this engine there; the first that does is taken."""
    missing: Callable[[str], CongraspError | None] = lambda backend: None
    """JAX backend -> what this machine lacks for it, or nothing."""
    on_device: bool = False
    """Whether rollouts stay on the learner's device, so that by default one actor lives in the learner's process."""
    title: str = ""
    """Its name for people; that of the row if empty."""


ENGINES: dict[str, Engine] = {}
"""Engines by the names that `--physics` takes beside `auto`."""


def engine_title(name: str) -> str:
    """An engine's name for people."""
    return (name in ENGINES and ENGINES[name].title) or name


PhysicsName = Annotated[
    str,
    tyro.conf.arg(
        constructor_factory=lambda: Literal.__getitem__(("auto", *ENGINES)),  # type: ignore[attr-defined]
        help_behavior_hint=lambda default: (
            "(default: " + default.strip("[']") + ")"
        ),  # such a choice is shown as a list
    ),
]
"""`auto` or a key of `ENGINES`; a command line offers those that are registered when it is parsed."""
