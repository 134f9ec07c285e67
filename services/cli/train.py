"""`congrasp train`: a learner and its actors on this machine."""

import dataclasses
import pathlib
import time
from collections.abc import Callable
from typing import Annotated

import tyro

from common.config import Board, RunConfig
from learner.run_directory import CONFIG_FILE, open_run
from services.train.presets import get_preset, with_hand


@dataclasses.dataclass(frozen=True)
class Train:
    """Trains a policy: one learner and its actors on this machine, over Zenoh on the loopback interface.

    Starts from a preset (`--preset quickstart`, `human`, `allegro` or `sharpa`); every field of the run can be set on
    the command line.
    """

    config: Annotated[RunConfig, tyro.conf.arg(name="")]
    preset: str = "quickstart"
    """Named configuration to start from."""
    hand: str | None = None
    """The hand, by its name or its file ('congrasp hands list', 'congrasp hands import'); by default the preset's."""
    run_dir: pathlib.Path | None = None
    """Where the run is kept; runs/NAME-DATE by default."""
    actors: int | None = None
    """Actor processes. By default two; on a GPU none: a single actor then lives in the learner's process, and rollouts
    never leave the device."""
    ranks: int = 1
    """Learners that train together, data parallel; each has a GPU of its own where there are GPUs, and --actors actors.
    The batch grows with them."""
    initial: pathlib.Path | None = None
    """A policy to begin with instead of random weights, of the same networks: `policy.safetensors` of a run."""
    resume: bool = False
    """Go on from the latest checkpoint in --run-dir, with the run's own configuration; what the learner alone uses,
    such as --updates and --ppo.…, may be changed."""
    listen: str | None = None
    """Endpoint where actors of other machines may join, such as tls/0.0.0.0:7447; on this machine alone by default."""
    certs: pathlib.Path | None = None
    """The authority's folder (congrasp certs), for mutual TLS."""
    insecure: bool = False
    """Listen beyond loopback without certificates."""
    evaluation: int = 64
    """Episodes of the evaluation before and after training, for each of three seeds; 0 leaves it out."""
    boards: tuple[Board, ...] = ("tensorboard",)
    """Where the learner's figures are shown, too: tensorboard (files in the run's folder), wandb-offline (files there,
    for `wandb sync`), wandb (needs an account); with no name none."""
    metrics_port: int = 0
    """Port of the learner's Prometheus endpoint, http://127.0.0.1:PORT/metrics; 0 for none."""

    def run(self) -> int:
        """Runs the command."""
        from services.train.command import run_training

        config = with_hand(self.config, self.hand)
        run_dir = self.run_dir or pathlib.Path("runs") / f"{config.name}-{time.strftime('%Y%m%d-%H%M%S')}"
        return run_training(
            config,
            run_dir,
            actors=self.actors,
            resume=self.resume,
            initial=self.initial,
            evaluation=self.evaluation,
            ranks=self.ranks,
            boards=self.boards,
            metrics_port=self.metrics_port,
            listen=self.listen,
            certs=self.certs,
            insecure=self.insecure,
        )


def begun(arguments: list[str]) -> tuple[str, RunConfig]:
    """The preset that a command line names, and the configuration that all its other options start from.

    With --resume that is the run's own.
    """
    preset = _value("--preset", arguments) or "quickstart"
    run_dir = _value("--run-dir", arguments)
    if {"--resume", "--or-resume"} & set(arguments) and run_dir and (pathlib.Path(run_dir) / CONFIG_FILE).exists():
        return preset, open_run(pathlib.Path(run_dir))
    return preset, get_preset(preset)


def _value(option: str, arguments: list[str]) -> str:
    for word, following in zip(arguments, [*arguments[1:], ""], strict=True):
        if word.partition("=")[0] == option:
            return word.partition("=")[2] or following
    return ""


def parse(arguments: list[str]) -> Callable[[], int]:
    """The call that these arguments ask for."""
    preset, config = begun(arguments)
    return tyro.cli(Train, prog="congrasp train", args=arguments, default=Train(config=config, preset=preset)).run
