"""`congrasp learner`: the learner alone."""

import contextlib
import dataclasses
import pathlib

import congrasp.actors.physics  # noqa: F401 - registers the engines that --physics offers
from congrasp.common.config import MetricWriter, RunConfig, run_config_from_json, to_json
from congrasp.common.errors import CongraspError
from congrasp.common.transport import urls
from congrasp.common.transport.ports import LEARNER_URL, rank_url, reachable_url
from congrasp.services.cli.train import defaults as defaults
from congrasp.services.ops.lifetime import on_signal
from congrasp.services.ops.logs import Watch, log, log_error, logging_as
from congrasp.services.train.presets import with_hand


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of a learner's process."""

    run_dir: pathlib.Path
    """Directory of the run."""
    preset: str = "quickstart"
    """Named initial configuration."""
    hand: str | None = None
    """The hand, by its name or its file; by default the preset's."""
    listen: str = LEARNER_URL
    """Endpoint for the actors, which takes four ports from this one on. Other machines need
    tls/0.0.0.0:PORT.
    """
    certs: pathlib.Path | None = None
    """Folder of a learner's certificate (congrasp certs): enables mutual TLS, and restricts each
    role to its rights.
    """
    insecure: bool = False
    """Listen beyond loopback without certificates."""
    initial: pathlib.Path | None = None
    """A policy to begin with instead of random weights, of the same networks: `policy.safetensors`
    of a run, or a policy of the package, whose critic starts again.
    """
    teacher: str | None = None
    """A policy file, or the hand of a pretrained policy, to distil, as for `congrasp train`; ranks
    read it.
    """
    resume: bool = False
    """Resume the run in --run-dir from its newest intact checkpoint; a run without a checkpoint
    starts again.
    """
    or_resume: bool = False
    """Begin the run, or resume it if --run-dir holds one: for supervisors that give the same
    command every time.
    """
    rank: int = 0
    """Number of this process among several that train together; each needs a separate GPU
    (CUDA_VISIBLE_DEVICES).
    """
    ranks: int = 1
    """Learner processes that train together: data parallel, each with separate actors. The run is
    in the --run-dir of rank 0; rank r listens 4 r ports above --listen."""
    coordinator: str = "127.0.0.1:7440"
    """Host and port of rank 0; this port and the next must be free there."""
    inside: bool = False
    """Also run an actor in this process, so that its rollouts never leave the device."""
    metric_writers: tuple[MetricWriter, ...] = ("tensorboard",)
    """Additional metric writers: tensorboard (files in the run's folder), wandb-offline (files
    there, for `wandb sync`), wandb (needs an account); without a name, none."""

    def prepare(self, config: RunConfig) -> None:
        """Creates the directory of the run, or stores the configuration with which it continues."""
        from congrasp.common.policy import bundle as bundles
        from congrasp.learner.run_directory import (
            CONFIG_FILE,
            continue_run,
            create_run,
            initial_notes,
        )

        if self.resume or (self.or_resume and (self.run_dir / CONFIG_FILE).exists()):
            continue_run(self.run_dir, config)
            return
        if self.initial is None:
            create_run(self.run_dir, config)
            return
        initial = bundles.load(self.initial)
        create_run(self.run_dir, config, initial)
        for note in initial_notes(initial, config, self.initial):
            log("info", note)


def learner(options: Options, config: RunConfig, watch: Watch = Watch()) -> int:  # noqa: B008
    """Run only the learner; actors on this or other machines connect to it with `congrasp actor
    --connect`.

    A new run takes its configuration from the preset and the command line; a directory with a run
    keeps its configuration, except for --updates, --ppo.… and others that only the learner uses.

    Args:
      options: This process.
      config: The run.
      watch: Monitoring.

    Examples:
      congrasp learner --preset human --run-dir runs/human --listen tls/0.0.0.0:7447 --certs certs
      congrasp learner --run-dir runs/human --resume
    """
    from congrasp.common.runtime.stages import imported
    from congrasp.learner.distributed.ranks import Ranks, end_process
    from congrasp.learner.run_directory import listening
    from congrasp.services.train.learn import learn, longest_rollout

    run_dir, rank, config = options.run_dir, options.rank, with_hand(config, options.hand)
    try:
        with (
            on_signal() as stop,
            logging_as(watch.log_format, role="learner", id=str(rank), run=config.name),
            urls.listen(
                url := rank_url(options.listen, rank),
                "learner",
                certs=options.certs,
                insecure=options.insecure,
                run=config.name,
                longest_rollout=longest_rollout(config)
                if options.ranks == 1
                else None,  # others use rank 0's settings
            ) as transport,
        ):
            imported()
            if rank == 0:
                options.prepare(config)
            ranks = Ranks.join(rank, options.ranks, options.coordinator)
            config = run_config_from_json(
                ranks.exchange({"config": to_json(config)}).meta["entries"][0]["config"]
            )
            with listening(run_dir, reachable_url(url)) if rank == 0 else contextlib.nullcontext():
                learn(
                    run_dir,
                    config,
                    wire=transport,
                    inside=config.physics if options.inside else None,
                    stop=stop,
                    ranks=ranks,
                    writers=options.metric_writers,
                    watch=watch,
                    on_update=_log_update,
                    on_event=log,
                )
            return stop.exit_code
    except CongraspError as error:
        if options.ranks > 1:
            log_error(str(error))
            end_process(str(error), error.exit_code)
        raise


def _log_update(values: dict[str, float]) -> None:
    """Logs the metrics of an update."""
    log("info", f"Update {values['update']:.0f}: {values['steps_per_second']:.0f} steps/s.", values)


COMMAND = learner
