"""Flow of `congrasp train`: trains, evaluates, and shows results and next steps."""

import contextlib
import dataclasses
import os
import pathlib
import shlex
import shutil
import sys
import time
from collections.abc import Iterator
from typing import Any, Self

from rich.console import Console
from rich.markup import escape
from rich.padding import Padding

from congrasp.common.config import ObjectsConfig, RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.named_inputs import identified
from congrasp.common.objects.pool import HELD_OUT_SEED, load_pool
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.bundle import PolicyBundle, policy_spec
from congrasp.common.runtime.stages import (
    Stage,
    logged_stages,
    record_import_stage,
    since_start,
    stages,
)
from congrasp.learner.algorithms import make_algorithm
from congrasp.learner.checkpoint import Checkpoints
from congrasp.learner.run_directory import (
    CHECKPOINTS,
    CONFIG_FILE,
    LOGS,
    POLICY_FILE,
    continue_run,
    create_run,
    has_checkpoints,
    initial_notes,
    open_run,
    supervised,
)
from congrasp.services.client.policy_client import PolicyClient
from congrasp.services.evaluate.experiment import Experiment, Variation
from congrasp.services.ops.lifetime import Stop, on_signal
from congrasp.services.ops.logs import MonitoringOptions
from congrasp.services.serve.load import example_episode, one_answer, serve_policy
from congrasp.services.train.launch import Launch, Plan
from congrasp.services.train.learn import InnerActor, Monitoring, learn
from congrasp.services.train.presets import FULL, easier
from congrasp.services.train.processes import START, ProcessDied, train
from congrasp.services.train.start import (
    Folder,
    can_resume,
    check_config,
    check_ranges,
    kept_log,
    removed_without_checkpoint,
)

EPISODE = "episode.png"
RUNS = "runs"
"""Folder of runs without --run-dir."""
_EVALUATION_OBJECTS = 12
_LINE_INTERVAL_S = 10.0
"""Time between two lines of progress without a terminal."""
_LEAST_FREE_BYTES = 64 << 10
"""Free space below which a disk counts as full."""
_FIRST_CHILDREN = ("learner.log", "rank-0.log", "actor-0.log")
"""Logs of the first learner and the first actor."""
console = Console(highlight=False, soft_wrap=True)


def run_training(
    config: RunConfig,
    run_dir: pathlib.Path | None,
    launch: Launch,
    *,
    resume: bool,
    evaluation: int,
    initial: pathlib.Path | None = None,
) -> int:
    """Trains, evaluates and shows the result; `services.cli.train` describes the arguments.

    Returns:
      The exit code.

    Raises:
      CongraspError: the arguments contradict each other, the configuration cannot run, another
        process trains in the folder, or a process failed permanently.
    """
    record_import_stage()
    if run_dir is None:
        raise CongraspError("--resume needs the folder of a run.", _folders_to_resume())
    plan = launch.planned(config)
    before = Folder.of(run_dir)
    with contextlib.ExitStack() as stack:
        if resume:
            open_run(run_dir)
            stack.enter_context(supervised(run_dir, _warn))
        config = _prepare(run_dir, config, initial, resume=resume)
        if not resume:
            stack.enter_context(supervised(run_dir, _warn))
            stack.enter_context(removed_without_checkpoint(before))
        stop = stack.enter_context(on_signal())
        _announce(config, run_dir, plan)
        began = time.monotonic()
        with TrainingProgress(config, run_dir / LOGS) as progress:
            _train(run_dir, config, plan, stop, progress)
        minutes = (time.monotonic() - began) / 60
        if stop.is_set():
            console.print(_stopped(run_dir, stop), markup=False)
            return stop.exit_code
        console.print(f"Trained for {minutes:.1f} min.")
        if evaluation:
            _show(run_dir, config, evaluation)
        print_next_steps(run_dir)
        console.print(f"\nThe training ends: all {config.updates} updates are done.")
    return 0


def _train(
    run_dir: pathlib.Path, config: RunConfig, plan: Plan, stop: Stop, progress: "TrainingProgress"
) -> None:
    """Trains in this process, or with one process for each role."""
    if plan.in_process:
        learn(
            run_dir,
            config,
            wire=None,
            inside=InnerActor(plan.physics),
            stop=stop,
            monitoring=Monitoring(
                on_update=progress.update,
                on_event=_warn_of_error,
                writers=plan.launch.learner.metric_writers,
                watch=MonitoringOptions(metrics_port=plan.launch.metrics_port),
            ),
        )
        return
    with _full_disk_named(run_dir):
        try:
            train(run_dir, config, plan, stop=stop, report=progress.show, notify=_warn)
        except ProcessDied as error:
            if can_resume(run_dir):
                resume = _resume_command(run_dir)
                raise CongraspError(str(error), f"To resume: {resume}") from None
            log = kept_log(run_dir, error.log)
            raise ProcessDied(error.what, log) from None


def _stopped(run_dir: pathlib.Path, stop: Stop) -> str:
    """The last line of a training that was stopped."""
    if can_resume(run_dir):
        return f"The training was {stop.reason}. To resume: {_resume_command(run_dir)}"
    return f"The training was {stop.reason} before its first checkpoint; nothing is left of it."


def _resume_command(run_dir: pathlib.Path) -> str:
    """Command line that resumes a run."""
    return shlex.join([*_command(), "train", "--resume", "--run-dir", str(run_dir)])


def _folders_to_resume() -> str:
    """Remedy for a resume without a folder: the newest run of the default folder."""
    runs = [path.parent for path in pathlib.Path(RUNS).glob(f"*/{CONFIG_FILE}")]
    if not runs:
        return "Pass --run-dir FOLDER."
    newest = max(runs, key=lambda run: run.stat().st_mtime)
    return f"Pass --run-dir FOLDER, such as {shlex.quote(str(newest))}, the newest one here."


def _warn(text: str) -> None:
    """Prints a line about the run's processes."""
    console.print(f"  {text}", style="yellow", markup=False)


def _warn_of_error(level: str, text: str) -> None:
    """Prints an event of the learner that is an error."""
    if level == "error":
        _warn(text)


def _prepare(
    run_dir: pathlib.Path, config: RunConfig, initial: pathlib.Path | None, *, resume: bool
) -> RunConfig:
    """Creates the run's directory, or opens the existing one; returns the run's configuration."""
    if resume:
        check_ranges(config)
        config = continue_run(run_dir, config, initial)
        if not has_checkpoints(run_dir):
            raise CongraspError(
                f"{run_dir} has no checkpoint to resume from.", "Start again in another --run-dir."
            )
        Checkpoints(run_dir / CHECKPOINTS).find(
            lambda level, text: console.print(text, markup=False)
        )
        return config
    if run_dir.exists() and any(run_dir.iterdir()) and not (run_dir / CONFIG_FILE).exists():
        raise CongraspError(
            f"{run_dir} is not empty and is not a run.", "Choose another --run-dir."
        )
    check_config(config)
    policy = None if initial is None else bundles.load(initial)
    config = identified(config, initial)
    create_run(run_dir, config, policy)
    if policy is not None and initial is not None:
        for note in initial_notes(policy, config, initial):
            console.print(note, markup=False)
    return config


def _announce(config: RunConfig, run_dir: pathlib.Path, plan: Plan) -> None:
    """Prints the run's summary and its simplifications."""
    ranks = plan.launch.ranks
    steps = ranks * config.rollout_steps * config.environments * config.rollouts_per_update
    console.print(
        f"[bold]{config.name}[/]: {config.updates} updates of {steps} steps, "
        f"{ranks * (plan.actors or 1)} actor(s) with {config.environments} hands each on "
        f"'{plan.physics}' in {escape(str(run_dir))}"
    )
    simplifications = easier(config)
    if simplifications:
        console.print(
            f"Easier than the full task: {'; '.join(simplifications)}.\nThe full task is --preset "
            f"{FULL}, for a GPU."
        )


@contextlib.contextmanager
def _full_disk_named(run_dir: pathlib.Path) -> Iterator[None]:
    """Context that reports a full disk, since a process that dies of it cannot write its error to
    its log.
    """
    try:
        yield
    except CongraspError:
        if shutil.disk_usage(run_dir).free >= _LEAST_FREE_BYTES:
            raise
        remedy = "Free space and start again."
        if can_resume(run_dir):
            remedy = (
                f"Files written before are intact. Free space; to resume: "
                f"{_resume_command(run_dir)}"
            )
        raise CongraspError(
            f"The disk of {run_dir} is full, and the run has ended.", remedy
        ) from None


def untrained(config: RunConfig) -> PolicyBundle:
    """Returns the initial policy of the run."""
    spec = policy_spec(config.task, config.network)
    algorithm = make_algorithm(spec, config)
    policy = algorithm.policy(algorithm.init(config.seed))
    return PolicyBundle(
        spec=spec,
        task=config.task,
        version=0,
        run_id="untrained",
        transitions=0,
        **policy._asdict(),
    )


class TrainingProgress:
    """One line that is updated on a terminal; elsewhere a line about every ten seconds."""

    def __init__(self, config: RunConfig, logs: pathlib.Path):
        """Shows nothing until the context is entered.

        Args:
          config: the run's configuration.
          logs: folder of the logs of learners and actors.
        """
        self._config = config
        self._logs = logs
        self._began = time.monotonic()
        self._last = 0.0
        self._first: tuple[float, float] | None = None
        self._line = ""
        self._printed = ""
        self._live = console.status("compiling, and filling the first batch")  # of a terminal

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._live.stop()
        self._print()

    def update(self, values: dict[str, float]) -> None:
        """Shows the metrics of an update of this process's learner."""
        self.show(
            {
                "values": values,
                "actors": 1,
                "update": values["update"],
                "version": int(values["version"]),
            }
        )

    def show(self, status: dict[str, Any]) -> None:
        """Shows the learner's newest metrics, if any, the number of actors and, after the first
        update, the start.
        """
        now = time.monotonic()
        if "transitions" in status.get("values", {}):
            if self._first is None:
                console.print(f"[dim]{first_update(self._logs)}[/]")
            self._line = self._progress(status, now)
        elif self._first is None:
            self._line = (
                f"compiling, and filling the first batch: {now - self._began:.0f} s, "
                f"{status['actors']} actor(s)"
            )
        # A text would be cropped, since the console does not wrap
        self._live.update(Padding(self._line, 0))
        if not console.is_terminal and now - self._last >= _LINE_INTERVAL_S:
            self._last = now
            self._print()

    def _print(self) -> None:
        """Prints the line if it has changed."""
        if self._line != self._printed:
            console.print(f"  {self._line}", markup=False)
            self._printed = self._line

    def _progress(self, status: dict[str, Any], now: float) -> str:
        """Formats the metrics as one line; the time left is estimated from the first update on,
        without compilation.
        """
        values = status["values"]
        updates = self._config.updates
        update = status["update"]
        if self._first is None:
            self._first = (now, update)
        time_of_first, first = self._first
        pace = (update - first) / max(now - time_of_first, 1e-6)
        left = "?"
        if pace > 0:
            minutes, seconds = divmod(int((updates - update) / pace), 60)
            left = f"{minutes}:{seconds:02d}"
        return (
            f"update {update:4.0f}/{updates}  {values['steps_per_second']:6.0f} steps/s  "
            f"version {status['version']}  lag {values.get('staleness_mean', 0.0):.1f}  "
            f"success {100 * values.get('episode/success', float('nan')):5.1f} %  "
            f"links {values.get('episode/links_at_removal', float('nan')):4.1f}  "
            f"return {values.get('episode/return', float('nan')):6.1f}  actors {status['actors']}  "
            f"left {left}"
        )


def first_update(logs: pathlib.Path | None = None) -> str:
    """Stages of this process, of the first learner and of the first actor until the first update,
    one on each line.

    Args:
      logs: folder of the logs of learners and actors; None if they are in this process.
    """
    all_stages = stages()
    if logs is not None:
        all_stages += _stages_of_children(logs)
    all_stages.sort(key=lambda one: one.began)
    lines = [f"    {one.began:6.1f} to {one.ended:6.1f} s: {one.name}" for one in all_stages]
    return "\n".join(
        [
            f"  First update {since_start():.1f} s after the start; its stages, partly in "
            f"parallel:",
            *lines,
        ]
    )


def _stages_of_children(logs: pathlib.Path) -> list[Stage]:
    """Stages of the first learner and the first actor, which other processes resemble."""
    start = next((one for one in stages() if one.name == START), None)
    if start is None:  # learner and actor are threads of this process
        return []
    children: list[Stage] = []
    for name in _FIRST_CHILDREN:
        log = logs / name
        for one in logged_stages(log, start.began):
            children.append(one._replace(name=f"{log.stem}: {one.name}"))
    return children


def _show(run_dir: pathlib.Path, config: RunConfig, episodes: int) -> None:
    """Evaluates headings on held-out objects, draws one episode (a success if possible), and
    queries a server.
    """
    objects = config.objects
    if not objects.folder:
        objects = ObjectsConfig(
            families=objects.families, count=_EVALUATION_OBJECTS, seed=HELD_OUT_SEED
        )
    pool = load_pool(objects)
    console.print(f"Evaluating {episodes} episodes on {len(pool)} held-out objects …")
    policy = dataclasses.replace(bundles.load(run_dir / POLICY_FILE), task=config.task)
    heading = Experiment(
        policy, pool, episodes=episodes, batch=episodes, hold=config.task.hold_steps, measured=False
    )
    # The server starts while the episodes run.
    with serve_policy(run_dir / POLICY_FILE, run_dir / LOGS / "serve.log") as (endpoint, _):
        (result,) = heading.run([Variation()], keep=True)
        from congrasp.services.viz.render import episode_sheet  # seconds, for the end of a run
        from congrasp.services.viz.sheets import save_png

        save_png(run_dir / EPISODE, episode_sheet(result.examples(1, 1)[-1]))
        row = result.row
        console.print(
            f"[bold]Success {100 * row.success:.1f} %[/] (95 % interval "
            f"{100 * row.success_low:.1f} to "
            f"{100 * row.success_high:.1f}): "
            f"{row.links_at_removal:.1f} links touch the object when the table is removed."
        )
        console.print("\n[bold]One live query[/] of a policy server in a separate process:")
        episode = example_episode(HELD_OUT_SEED, config.task.hand)
        with PolicyClient(endpoint, hand=episode.hand, wait=180.0, timeout=5.0) as client:
            client.metadata()
            console.print(one_answer(client, episode), markup=False)


def print_next_steps(run_dir: pathlib.Path) -> None:
    """Prints the location of the results and commands to inspect them."""
    congrasp = _command()
    folder = str(run_dir)
    policy = str(run_dir / POLICY_FILE)
    rows: list[tuple[str, str]] = []
    if (run_dir / EPISODE).exists():
        rows.append((str(run_dir / EPISODE), "an episode of the trained policy"))
    rows += [
        (
            shlex.join([*congrasp, "grasp", "mug:0", "--video"]),
            "a grasp by the pretrained policy of the full task; or your own mesh",
        ),
        (shlex.join([*congrasp, "plot", folder]), "learning curves and reward terms"),
        (
            f"{shlex.quote(str(run_dir / LOGS))}/*.mcap",
            "open in Foxglove or Rerun: plots, hand and object in 3-D",
        ),
        (shlex.join([*congrasp, "evaluate", "--policy", policy]), "the paper's protocol"),
        (_resume_command(run_dir), "continue training"),
    ]
    console.print("\n[bold]Next[/]")
    for what, why in rows:
        console.print(f"  {what}\n      {why}", markup=False)


def _command() -> list[str]:
    """Command line of this installation."""
    script = pathlib.Path(sys.executable).with_name("congrasp")
    on_path = shutil.which("congrasp") or not script.exists()
    return ["congrasp" if on_path else os.path.relpath(script)]
