"""`congrasp learner`: the learner alone."""

import dataclasses
import pathlib
from collections.abc import Callable
from typing import Annotated

import tyro

from common.config import Board, RunConfig, run_config_from_json, to_json
from services.cli.train import begun
from services.cli.watch import Watch, Watched
from services.train.presets import with_hand


@dataclasses.dataclass(frozen=True)
class Learner:
    """The learner alone; actors on this machine or on others connect to it with `congrasp actor --connect`.

    A new run takes its configuration from the preset and the command line; a directory that holds a run keeps its own,
    but for --updates, --ppo.… and others that the learner alone uses.
    """

    config: Annotated[RunConfig, tyro.conf.arg(name="")]
    run_dir: pathlib.Path
    """Where the run is kept."""
    preset: str = "quickstart"
    """Named configuration to start from."""
    hand: str | None = None
    """The hand, by its name or its file; by default the preset's."""
    listen: str = "tcp/127.0.0.1:7447"
    """Endpoint for the actors, which takes four ports from this one on. Other machines need tls/0.0.0.0:PORT."""
    certs: pathlib.Path | None = None
    """Folder of a learner's certificate (congrasp certs): mutual TLS, and each role may do only what is its own."""
    insecure: bool = False
    """Listen beyond loopback without certificates."""
    initial: pathlib.Path | None = None
    """A policy to begin with instead of random weights, of the same networks: `policy.safetensors` of a run."""
    resume: bool = False
    """Go on with the run in --run-dir, from its latest checkpoint if it has one."""
    or_resume: bool = False
    """Begin the run, or go on with it if --run-dir holds one: for supervisors that give the same command every time."""
    rank: int = 0
    """Number of this process among several that train together; each needs a GPU of its own (CUDA_VISIBLE_DEVICES)."""
    ranks: int = 1
    """Learner processes that train together: data parallel, each with actors of its own. The run is that in the
    --run-dir of rank 0; rank r listens 4 r ports above --listen."""
    coordinator: str = "127.0.0.1:7440"
    """Where the ranks find rank 0: its host and a port, which and the next of which must be free there."""
    inside: bool = False
    """An actor lives in this process, too, so that its rollouts never leave the device."""
    boards: tuple[Board, ...] = ("tensorboard",)
    """Where the learner's figures are shown, too: tensorboard (files in the run's folder), wandb-offline (files there,
    for `wandb sync`), wandb (needs an account); with no name none."""
    watch: Watched = dataclasses.field(default_factory=Watch)
    """How it is watched."""

    def run(self) -> int:
        """Runs the command."""
        from common.errors import CongraspError
        from learner.ranks import end_process

        try:
            return self._learn()
        except CongraspError as error:
            if self.ranks > 1:
                end_process(str(error), error.exit_code)
            raise

    def _learn(self) -> int:
        import functools

        from common.policy import bundle as bundles
        from common.transport.keys import FLOWS
        from common.transport.zenoh_transport import ZenohTransport, shifted
        from learner.process import run_learner
        from learner.ranks import Ranks
        from learner.run_directory import continue_run, create_run
        from services.ops.access import listening
        from services.ops.logs import say
        from services.ops.metrics import LearnerMetrics
        from services.ops.shutdown import on_signal
        from services.ops.status import ask
        from services.train.metric_writers import recorded
        from services.train.train import train_in_process

        resume = self.resume and (self.run_dir / "checkpoints" / "latest").exists()
        config = with_hand(self.config, self.hand)
        listen = shifted(self.listen, self.rank * len(FLOWS))
        credentials = listening(listen, self.certs, "learner", insecure=self.insecure)
        with on_signal() as stop, ZenohTransport(listen=[listen], credentials=credentials) as transport:
            if self.rank == 0 and self.resume:
                continue_run(self.run_dir, config)
            elif self.rank == 0:
                create_run(self.run_dir, config, None if self.initial is None else bundles.load(self.initial))
            ranks = Ranks.join(self.rank, self.ranks, self.coordinator)
            config = run_config_from_json(ranks.exchange({"config": to_json(config)}).meta["entries"][0]["config"])
            metrics = LearnerMetrics(functools.partial(ask, transport, config.name))

            def updated(values: dict[str, float]) -> None:
                metrics.update(values)
                say("info", f"Update {values['update']:.0f}: {values['steps_per_second']:.0f} steps/s.", values)

            with self.watch.watched("learner", str(self.rank), config.name, metrics):
                if self.inside:
                    train_in_process(
                        self.run_dir,
                        config,
                        physics=config.physics,
                        stop=stop,
                        resume=resume,
                        ranks=ranks,
                        wire=transport,
                        boards=self.boards,
                        on_update=updated,
                        on_event=say,
                    )
                else:
                    run_learner(
                        self.run_dir,
                        config,
                        transport,
                        stop_event=stop,
                        resume=resume,
                        ranks=ranks,
                        recorder=recorded(transport, config, self.run_dir, self.boards) if self.rank == 0 else None,
                        on_update=updated,
                        on_event=say,
                    )
            return stop.exit_code


def parse(arguments: list[str]) -> Callable[[], int]:
    """The call that these arguments ask for."""
    preset, config = begun(arguments)
    default = Learner(config=config, run_dir=tyro.MISSING, preset=preset)
    learner = tyro.cli(Learner, prog="congrasp learner", args=arguments, default=default)
    if learner.or_resume and (learner.run_dir / "config.json").exists():
        learner = dataclasses.replace(learner, resume=True)
    return learner.run
