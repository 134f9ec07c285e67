"""`congrasp learner`: the learner alone."""

import contextlib
import dataclasses
import pathlib
import shlex
from typing import Annotated, Any

import tyro

import congrasp.actors.physics  # noqa: F401 - registers the engines that --physics offers
from congrasp.common.config import RunConfig, run_config_from_json, to_json
from congrasp.common.errors import CongraspError
from congrasp.common.transport import urls
from congrasp.common.transport.ports import LEARNER_URL, rank_url, reachable_url
from congrasp.services.cli.arguments import option_value
from congrasp.services.cli.train import defaults as defaults_of_preset
from congrasp.services.ops.lifetime import Stop, command, on_signal
from congrasp.services.ops.logs import MonitoringOptions, log, log_error, logging_as
from congrasp.services.train.launch import LearnerOptions, read_launch
from congrasp.services.train.presets import with_hand


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of a learner's process."""

    run_dir: pathlib.Path
    """Folder of the run."""
    launch: pathlib.Path | None = None
    """`launch.json` of a run that `congrasp train` started, whose values are the defaults of the
    other options. `congrasp train` passes it to its processes.
    """
    preset: str = "quickstart"
    """Configuration to start from, as for `congrasp train`."""
    hand: str | None = None
    """Name or file of the hand; by default the hand of the preset."""
    listen: str = LEARNER_URL
    """Endpoint for actors. It uses this port and the next three. For actors on other machines, pass
    tls/0.0.0.0:PORT.
    """
    certs: pathlib.Path | None = None
    """Folder of the learner's certificate (congrasp certs). It enables mutual TLS, and restricts
    each role to its rights.
    """
    initial: pathlib.Path | None = None
    """Policy whose weights replace the random initial weights: `policy.safetensors` of a run, or a
    policy of the package. Its networks must have the sizes of the run. A policy of the package has
    no critic, so the critic starts from random weights.
    """
    teacher: str | None = None
    """Policy to distil, as for `congrasp train`: a policy file, or the hand of a pretrained policy.
    Every rank reads it.
    """
    resume: bool = False
    """Resume the run in --run-dir from its newest intact checkpoint. A run without a checkpoint
    starts from the beginning.
    """
    or_resume: bool = False
    """Start the run, or resume it if --run-dir contains a run. This is for supervisors, which
    always start the same command.
    """
    rank: int = 0
    """Number of this process among the --ranks processes. Each process needs its own GPU
    (CUDA_VISIBLE_DEVICES).
    """
    ranks: int = 1
    """Number of learner processes for data-parallel training, each with its own actors. The run is
    in the --run-dir of rank 0. Rank r listens 4 r ports above --listen."""
    coordinator: str = "127.0.0.1:7440"
    """Host and port of rank 0. This port and the next one must be free on its machine."""
    inside: bool = False
    """Also run an actor in this process, so that its rollouts stay on the device."""
    shared: Annotated[LearnerOptions, tyro.conf.arg(name="")] = LearnerOptions()  # noqa: RUF009
    """Options of the learner that `congrasp train` has, too."""

    @property
    def resumes(self) -> bool:
        """True if the run in --run-dir continues."""
        from congrasp.learner.run_directory import CONFIG_FILE

        return self.resume or (self.or_resume and (self.run_dir / CONFIG_FILE).exists())

    def prepare(self, config: RunConfig) -> RunConfig:
        """Creates the directory of the run, or stores the configuration with which it continues;
        returns the configuration.
        """
        from congrasp.common.named_inputs import identified
        from congrasp.common.policy import bundle as bundles
        from congrasp.learner.run_directory import continue_run, create_run, initial_notes
        from congrasp.services.train.start import check_config, check_ranges

        if self.resumes:
            check_ranges(config)
            return continue_run(self.run_dir, config, self.initial)
        check_config(config)
        config = identified(config, self.initial)
        if self.initial is None:
            create_run(self.run_dir, config)
            return config
        initial = bundles.load(self.initial)
        create_run(self.run_dir, config, initial)
        for note in initial_notes(initial, config, self.initial):
            log("info", note)
        return config


def learner(
    options: Options,
    config: RunConfig,
    watch: MonitoringOptions = MonitoringOptions(),  # noqa: B008
) -> int:
    """Run only the learner. Actors on this or other machines connect to it with `congrasp actor
    --connect`.

    A new run has the configuration of the preset and the command line. A resumed run keeps its
    configuration, except for options that only the learner uses, such as --updates and --ppo.….

    Args:
      options: Options of this process.
      config: Configuration of the run.
      watch: Monitoring.

    Examples:
      congrasp learner --preset human --run-dir runs/human --listen tls/0.0.0.0:7447 --certs certs
      congrasp learner --run-dir runs/human --resume
    """
    from congrasp.common.named_inputs import COPY, OF_LEARNERS, check_inputs
    from congrasp.common.runtime.stages import record_import_stage
    from congrasp.learner.distributed.ranks import Ranks, end_process
    from congrasp.learner.run_directory import listening
    from congrasp.services.train.learn import InnerActor, Monitoring, learn, longest_rollout
    from congrasp.services.train.start import Folder, removed_without_checkpoint

    run_dir = options.run_dir
    rank = options.rank
    config = with_hand(config, options.hand)
    url = rank_url(options.listen, rank)
    # With several ranks, the configuration is that of rank 0, which is not known yet.
    max_rollout_bytes = longest_rollout(config) if options.ranks == 1 else None
    try:
        with (
            on_signal() as stop,
            logging_as(watch.log_format, role="learner", id=str(rank), run=config.name),
            urls.listen(
                url,
                "learner",
                certs=options.certs,
                insecure=options.shared.insecure,
                run=config.name,
                longest_rollout=max_rollout_bytes,
            ) as transport,
            contextlib.ExitStack() as stack,
        ):
            record_import_stage()
            if rank == 0:
                is_new = not options.resumes
                before = Folder.of(run_dir)
                config = options.prepare(config)
                if is_new:
                    stack.enter_context(removed_without_checkpoint(before))
                stack.enter_context(listening(run_dir, reachable_url(url)))
            # All ranks send their configuration, and use that of rank 0.
            ranks = Ranks.join(rank, options.ranks, options.coordinator)
            entries = ranks.exchange({"config": to_json(config)}).meta["entries"]
            config = run_config_from_json(entries[0]["config"])
            if rank:
                check_inputs(config.inputs, OF_LEARNERS, COPY)
            inside = InnerActor(config.physics) if options.inside else None
            learn(
                run_dir,
                config,
                wire=transport,
                inside=inside,
                stop=stop,
                ranks=ranks,
                monitoring=Monitoring(
                    on_update=_log_update,
                    on_event=log,
                    writers=options.shared.metric_writers,
                    watch=watch,
                    audit=options.shared.audit,
                ),
            )
            log("info", _end(run_dir, stop))
            return stop.exit_code
    except CongraspError as error:
        if options.ranks > 1:
            log_error(str(error))
            end_process(str(error), error.exit_code)
        raise


def _end(run_dir: pathlib.Path, stop: Stop) -> str:
    """The reason why the learner ends, for its last line."""
    from congrasp.services.train.start import can_resume

    if not stop.is_set():
        return "The learner ends: the run is complete."
    if not can_resume(run_dir):
        return f"The learner ends: {stop.reason} before its first checkpoint."
    resume = shlex.join(command("congrasp", "learner", run_dir=run_dir, resume=True))
    return f"The learner ends: {stop.reason}. To resume: {resume}"


def _log_update(values: dict[str, float]) -> None:
    """Logs the metrics of an update."""
    log("info", f"Update {values['update']:.0f}: {values['steps_per_second']:.0f} steps/s.", values)


def defaults(arguments: list[str]) -> dict[str, Any]:
    """Defaults that depend on a command line: those of `congrasp train`, or with --launch the
    values of that file.
    """
    launch_file = option_value("--launch", arguments)
    if not launch_file:
        return defaults_of_preset(arguments)
    from congrasp.learner.run_directory import open_run

    path = pathlib.Path(launch_file)
    record = read_launch(path)
    launch = record.launch
    is_first = option_value("--rank", arguments) in ("", "0")
    options = Options(
        run_dir=path.parent,
        launch=path,
        listen=record.endpoint,
        certs=launch.certs,
        resume=True,
        ranks=launch.ranks,
        coordinator=record.coordinator,
        inside=record.actors == 0,
        shared=launch.learner,
    )
    metrics_port = launch.metrics_port if is_first else 0
    return {
        "options": options,
        "config": open_run(path.parent),
        "watch": MonitoringOptions(metrics_port=metrics_port),
    }


COMMAND = learner
