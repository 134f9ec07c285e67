"""`congrasp learner`: the learner alone."""

import contextlib
import pathlib
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import tyro

from congrasp.common.config import MetricWriter, RunConfig, run_config_from_json, to_json
from congrasp.common.transport.ports import LEARNER_URL, rank_url, reachable_url
from congrasp.services.cli.train import defaults as defaults
from congrasp.services.cli.watch import Watch, Watched
from congrasp.services.train.presets import with_hand

if TYPE_CHECKING:
    from congrasp.common.transport.base import Transport
    from congrasp.learner.distributed.ranks import Ranks


def learner(
    config: Annotated[RunConfig, tyro.conf.arg(name="")],
    run_dir: pathlib.Path,
    preset: str = "quickstart",
    hand: str | None = None,
    listen: str = LEARNER_URL,
    certs: pathlib.Path | None = None,
    insecure: bool = False,
    initial: pathlib.Path | None = None,
    teacher: str | None = None,
    resume: bool = False,
    or_resume: bool = False,
    rank: int = 0,
    ranks: int = 1,
    coordinator: str = "127.0.0.1:7440",
    inside: bool = False,
    metric_writers: tuple[MetricWriter, ...] = ("tensorboard",),
    watch: Watched = Watch(),  # noqa: B008
) -> int:
    """Run only the learner; actors on this or other machines connect to it with `congrasp actor --connect`.

    A new run takes its configuration from the preset and the command line; a directory with a run keeps its
    configuration, except for --updates, --ppo.… and others that only the learner uses.

    Args:
      config: The run.
      run_dir: Directory of the run.
      preset: Named initial configuration.
      hand: The hand, by its name or its file; by default the preset's.
      listen: Endpoint for the actors, which takes four ports from this one on. Other machines need tls/0.0.0.0:PORT.
      certs: Folder of a learner's certificate (congrasp certs): enables mutual TLS, and restricts each role to its
        rights.
      insecure: Listen beyond loopback without certificates.
      initial: A policy to begin with instead of random weights, of the same networks: `policy.safetensors` of a run.
      teacher: A policy file, or the hand of a pretrained policy, to distil, as for `congrasp train`; ranks read it.
      resume: Resume the run in --run-dir from its newest intact checkpoint; a run without a checkpoint starts again.
      or_resume: Begin the run, or resume it if --run-dir holds one: for supervisors that give the same command every
        time.
      rank: Number of this process among several that train together; each needs a separate GPU (CUDA_VISIBLE_DEVICES).
      ranks: Learner processes that train together: data parallel, each with separate actors. The run is in the
        --run-dir of rank 0; rank r listens 4 r ports above --listen.
      coordinator: Host and port of rank 0; this port and the next must be free there.
      inside: Also run an actor in this process, so that its rollouts never leave the device.
      metric_writers: Additional metric writers: tensorboard (files in the run's folder), wandb-offline (files there,
        for `wandb sync`), wandb (needs an account); without a name, none.
      watch: Monitoring.

    Examples:
      congrasp learner --preset human --run-dir runs/human --listen tls/0.0.0.0:7447 --certs certs
      congrasp learner --run-dir runs/human --resume
    """
    from congrasp.common.errors import CongraspError
    from congrasp.common.policy import bundle as bundles
    from congrasp.common.transport import urls
    from congrasp.learner.distributed.ranks import Ranks, end_process
    from congrasp.learner.run_directory import CONFIG_FILE, continue_run, create_run, listening
    from congrasp.services.ops.shutdown import on_signal

    resume = resume or (or_resume and (run_dir / CONFIG_FILE).exists())
    try:
        config, url = with_hand(config, hand), rank_url(listen, rank)
        with (
            on_signal() as stop,
            urls.listen(
                url,
                "learner",
                certs=certs,
                insecure=insecure,
                run=config.name,
                longest_rollout=_longest_rollout(config)
                if ranks == 1
                else None,  # other ranks use rank 0's configuration
            ) as transport,
        ):
            if rank == 0 and resume:
                continue_run(run_dir, config)
            elif rank == 0:
                create_run(run_dir, config, None if initial is None else bundles.load(initial))
            joined = Ranks.join(rank, ranks, coordinator)
            config = run_config_from_json(joined.exchange({"config": to_json(config)}).meta["entries"][0]["config"])
            with listening(run_dir, reachable_url(url)) if rank == 0 else contextlib.nullcontext():
                _learn(
                    run_dir,
                    config,
                    transport,
                    stop,
                    joined,
                    resume=resume,
                    inside=inside,
                    writers=metric_writers,
                    watch=watch,
                )
            return stop.exit_code
    except CongraspError as error:
        if ranks > 1:
            end_process(str(error), error.exit_code)
        raise


def _longest_rollout(config: RunConfig) -> int:
    """Limit of rollout messages: twice the size of the run's rollouts, bytes."""
    from congrasp.common.policy.bundle import policy_spec
    from congrasp.learner.algorithms import make_algorithm
    from congrasp.learner.batch import rollout_form

    spec = policy_spec(config.task, config.network)
    form = rollout_form(config, spec, make_algorithm(spec, config).batch_schema)
    return 2 * sum(array.nbytes for array in form.zeros().values())


def _learn(
    run_dir: pathlib.Path,
    config: RunConfig,
    transport: "Transport",
    stop: threading.Event,
    ranks: "Ranks",
    *,
    resume: bool,
    inside: bool,
    writers: Sequence[MetricWriter],
    watch: Watch,
) -> None:
    """Runs the learner until it is finished or stopped."""
    from congrasp.learner.run_directory import has_checkpoints
    from congrasp.services.ops.logs import log
    from congrasp.services.train.learn import learn

    def updated(values: dict[str, float]) -> None:
        log("info", f"Update {values['update']:.0f}: {values['steps_per_second']:.0f} steps/s.", values)

    with watch.watched("learner", str(ranks.rank), config.name):
        learn(
            run_dir,
            config,
            wire=transport,
            inside=config.physics if inside else None,
            stop=stop,
            resume=resume and ranks.rank == 0 and has_checkpoints(run_dir),
            ranks=ranks,
            writers=writers,
            metrics_port=watch.metrics_port,
            metrics_host=watch.metrics_host,
            on_update=updated,
            on_event=log,
        )


COMMAND = learner
