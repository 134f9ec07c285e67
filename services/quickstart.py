"""What `congrasp train` does around training: evaluations, progress, a picture, what to look at next."""

import os
import pathlib
import sys
import time
from typing import Any

import numpy as np
from rich.console import Console

from actors.physics import resolve_physics
from common.config import ObjectsConfig, RunConfig
from common.errors import CongraspError
from common.objects.pool import HELD_OUT_SEED, load_pool
from common.policy import bundle as bundles
from common.policy.bundle import PolicyBundle, policy_spec
from learner import update as updates
from learner.process import LOGS, POLICY_FILE, create_run, open_run
from services.client import PolicyClient
from services.evaluate import Evaluator, Row
from services.load import example_episode, one_answer, serving, wait_until_ready
from services.render import episode_sheet
from services.sheets import save_png
from services.shutdown import on_signal
from services.train import train, train_in_process

_EVALUATION_OBJECTS = 12
_SEEDS = 3
console = Console(highlight=False)


def run_training(
    config: RunConfig, run_dir: pathlib.Path, *, actors: int, resume: bool, in_process: bool, evaluation: int
) -> int:
    """Trains, evaluates and shows; returns the exit code."""
    if actors < 1:
        raise CongraspError(f"--actors is {actors}.", "A run needs at least one actor.")
    physics = resolve_physics(config.physics)
    if resume:
        config = open_run(run_dir)
        if not (run_dir / "checkpoints" / "latest").exists():
            raise CongraspError(f"{run_dir} has no checkpoint to resume from.", "Start it anew in another --run-dir.")
    else:
        if run_dir.exists() and any(run_dir.iterdir()) and not (run_dir / "config.json").exists():
            raise CongraspError(f"{run_dir} is not empty and is no run.", "Choose another --run-dir.")
        create_run(run_dir, config)
    steps = config.rollout_steps * config.environments * config.ppo.rollouts_per_update
    console.print(
        f"[bold]{config.name}[/]: {config.updates} updates of {steps} steps, "
        f"{1 if in_process else actors} actor(s) with {config.environments} hands each on '{physics}' in {run_dir}"
    )
    with on_signal() as stop:
        before = _evaluate(untrained(config), config, evaluation, "before training") if evaluation else []
        began = time.monotonic()
        if in_process:
            train_in_process(run_dir, config, physics=physics, stop=stop, resume=resume, on_update=_show_update(config))
        else:
            progress = _Progress(config)
            train(
                run_dir,
                config,
                actors=actors,
                physics=physics,
                stop=stop,
                report=progress.show,
                notify=lambda text: console.print(f"  [yellow]{text}[/]"),
            )
        if stop.is_set():
            console.print(f"Stopped. Go on with: congrasp train --resume --run-dir {run_dir}")
            return stop.exit_code
        console.print(f"Trained for {(time.monotonic() - began) / 60:.1f} min.")
        policy = bundles.load(run_dir / POLICY_FILE)
        if evaluation:
            after = _evaluate(policy, config, evaluation, "after training")
            _compare(before, after)
            _live_query(run_dir)
            _picture(policy, config, run_dir)
        _next_steps(run_dir, evaluation > 0)
    return 0


def untrained(config: RunConfig) -> PolicyBundle:
    """The policy that the run starts from."""
    spec = policy_spec(config.task, config.network)
    state = updates.init_state(config.seed, spec.layout, spec.action_size, config.network, config.ppo)
    return PolicyBundle(spec, config.task, state.params, state.observation, state.value, 0, "untrained", 0)


class _Progress:
    """One line about every ten seconds, or a live line on a terminal."""

    def __init__(self, config: RunConfig):
        self._config = config
        self._last = 0.0
        self._first: tuple[float, float] | None = None

    def show(self, status: dict[str, Any]) -> None:
        """Shows the learner's newest metrics."""
        progress = status.get("values", {})
        now = time.monotonic()
        interval = 2.0 if sys.stdout.isatty() else 10.0
        if now - self._last < interval:
            return
        self._last = now
        alive = status["actors"]
        if "transitions" not in progress:
            if self._first is None:
                console.print(f"  compiling, and filling the first batch; {alive} actor(s)", style="dim")
            else:
                self._last = 0.0
            return
        update = progress["transitions"] / (
            self._config.rollout_steps * self._config.environments * self._config.ppo.rollouts_per_update
        )
        self._first = self._first or (now, update)
        pace = (update - self._first[1]) / max(now - self._first[0], 1e-6)
        left = (self._config.updates - update) / pace if pace > 0 else float("nan")
        console.print(
            f"  update {update:4.0f}/{self._config.updates}  {progress['steps_per_second']:6.0f} steps/s  "
            f"version {status['version']}  lag {progress.get('staleness_mean', 0.0):.1f}  "
            f"success {100 * progress.get('episode/success', float('nan')):5.1f} %  "
            f"links {progress.get('episode/links_at_removal', float('nan')):4.1f}  "
            f"return {progress.get('episode/return', float('nan')):6.1f}  actors {alive}  "
            f"left {_minutes(left)}"
        )


def _show_update(config: RunConfig) -> Any:
    progress = _Progress(config)

    def show(values: dict[str, float]) -> None:
        progress.show({"values": values, "actors": 1, "version": int(values["version"])})

    return show


def _minutes(seconds: float) -> str:
    return "?" if not np.isfinite(seconds) else f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


def _evaluator(policy: PolicyBundle, config: RunConfig, seed: int, batch: int) -> Evaluator:
    objects = load_pool(
        ObjectsConfig(families=config.objects.families, count=_EVALUATION_OBJECTS, seed=HELD_OUT_SEED)
        if not config.objects.folder
        else config.objects
    )
    return Evaluator(
        policy, objects, physics="native", batch=batch, threads=os.cpu_count() or 1, seed=seed, task=config.task
    )


def _evaluate(policy: PolicyBundle, config: RunConfig, episodes: int, when: str) -> list[Row]:
    """Rows of the heading constraint for three draws of episodes, on objects that training never sees."""
    console.print(f"Evaluating {when}: {_SEEDS} x {episodes} episodes on {_EVALUATION_OBJECTS} held-out objects …")
    return _evaluator(policy, config, 0, episodes).rows("heading", episodes, _SEEDS)


def _compare(before: list[Row], after: list[Row]) -> None:
    console.print(f"Before and after, mean ± standard deviation over {_SEEDS} draws of episodes:")
    for name, label, factor in (
        ("episode_return", "return", 1.0),
        ("links_at_removal", "links in contact at step 50", 1.0),
        ("success", "success, %", 100.0),
    ):
        old, new = (factor * np.array([getattr(row, name) for row in rows]) for rows in (before, after))
        clear = abs(new.mean() - old.mean()) > old.std(ddof=1) + new.std(ddof=1)
        console.print(
            f"  {label:28s} {old.mean():7.2f} ± {old.std(ddof=1):5.2f}  ->  {new.mean():7.2f} ± {new.std(ddof=1):5.2f}"
            f"   {'better than the noise' if clear and new.mean() > old.mean() else 'within the noise, or worse'}"
        )


def _live_query(run_dir: pathlib.Path) -> None:
    """Serves the policy from a process of its own, and asks it for one action."""
    console.print("\n[bold]One live query[/] of a policy server in a process of its own:")
    with serving(run_dir / POLICY_FILE, run_dir / LOGS / "serve.log") as endpoint:
        episode = example_episode(HELD_OUT_SEED)
        with PolicyClient(endpoint, wait=60.0, timeout=5.0) as client:
            wait_until_ready(client)
            console.print(one_answer(client, episode), markup=False)


def _picture(policy: PolicyBundle, config: RunConfig, run_dir: pathlib.Path) -> None:
    """A successful episode if a few tries find one."""
    evaluator = _evaluator(policy, config, 0, 1)
    save_png(run_dir / "episode.png", episode_sheet(evaluator.episode("heading", tries=12)))


def _next_steps(run_dir: pathlib.Path, picture: bool) -> None:
    console.print("\n[bold]What to look at next[/]")
    if picture:
        console.print(f"  {run_dir / 'episode.png'}: an episode of the trained policy")
    console.print(f"  congrasp plot {run_dir}: learning curves and reward terms")
    console.print(f"  {run_dir / 'logs'}/*.mcap: open in Foxglove or Rerun, hand and object in 3-D")
    console.print(f"  congrasp evaluate --policy {run_dir / POLICY_FILE}: the paper's protocol")
    console.print(f"  congrasp train --resume --run-dir {run_dir}: go on training")
