"""`congrasp train`: a learner and its actors on this machine."""

import dataclasses
import pathlib
import time
from typing import Any

import congrasp.actors.physics  # noqa: F401 - registers the engines that --physics offers
from congrasp.common.config import RunConfig, Split
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.io.inputs import file_name
from congrasp.common.task.methods import STUDENT, STUDENTS, with_method
from congrasp.services.cli.arguments import option_value
from congrasp.services.train.launch import Launch
from congrasp.services.train.presets import get_preset, with_hand


def train(  # noqa: PLR0913
    config: RunConfig,
    launch: Launch = Launch(),  # noqa: B008
    preset: str = "quickstart",
    method: str | None = None,
    hand: str | None = None,
    run_dir: pathlib.Path | None = None,
    initial: pathlib.Path | None = None,
    teacher: str | None = None,
    constraints: pathlib.Path | None = None,
    split: Split | None = None,
    resume: bool = False,
    evaluation: int | None = None,
) -> int:
    """Train a policy: one learner and its actors on this machine, over Zenoh on the loopback
    interface.

    Starts from a preset; every field of the run can be set on the command line. `--preset full
    --hand HAND` is the full task for any hand, by the recipe for all of them; human, allegro and
    sharpa are presets that mean the same.

    Args:
      config: The run.
      launch: Its processes.
      preset: Named configuration to start from: quickstart, full, human, allegro or sharpa; or
        check, which trains nothing and shows that physics, messages, log, server and pictures work
        here.
      method: Method whose settings are used: ours, a baseline or ablation of the paper (graspxl,
        dgrasp, no-dynamic-center, no-feedforward, two-phase, single-stage), or a policy for robots
        (student, with a tracker; camera, with a depth camera). By default that of the preset, ours.
      hand: The hand, by its name or its file ('congrasp hands list', 'congrasp hands import'); by
        default the preset's.
      run_dir: Folder of the run; runs/NAME-DATE by default.
      initial: A policy to begin with instead of random weights, of the same networks:
        `policy.safetensors` of a run, or a policy of the package, whose critic starts again.
      teacher: A policy file, or the hand of a pretrained policy, to distil into a policy for
        robots, which sees the joints, the wrist and a tracker's object poses, no forces and no
        velocities (docs/students.md), or with `--method camera` a partial point cloud
        (docs/camera.md). The task is the teacher's, the algorithm `distill`.
      constraints: Folder of constraint sets to learn from, such as captured ones ('congrasp
        constraints import'); their objects are those of --objects.folder, and --objects.procedural
        adds others.
      split: Split of these sets: training (the default), held out, or all.
      resume: Resume from the newest intact checkpoint in --run-dir, with the configuration of the
        run; options that only the learner uses, such as --updates and --ppo.…, may be changed.
      evaluation: Episodes of the evaluation after training, on held-out objects; by default 192, or
        three times --environments if that is less; 0 leaves it out.

    Examples:
      congrasp train --preset quickstart --run-dir runs/mine
      congrasp train --preset check
      congrasp train --preset human --run-dir runs/human --seed 5
    """
    from congrasp.services.train.command import RUNS, run_training

    config = with_hand(config if method is None else with_method(config, method), hand)
    changes: dict[str, Any] = {}
    if constraints is not None:
        changes["constraints"] = str(constraints)
    if split is not None:
        changes["split"] = split
    objects = dataclasses.replace(config.objects, **changes)
    if run_dir is None and not resume:
        name = file_name(config.name, "a run")
        run_dir = pathlib.Path(RUNS) / f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"
    if evaluation is None:
        evaluation = min(192, 3 * config.environments)
    return run_training(
        dataclasses.replace(config, objects=objects),
        run_dir,
        launch,
        resume=resume,
        initial=initial,
        evaluation=evaluation,
    )


def defaults(arguments: list[str]) -> dict[str, Any]:
    """Defaults that depend on a command line: the configuration of the preset for the given hand
    and teacher.

    With --resume the configuration is that of the run, and a preset for another hand is rejected.
    """
    preset = option_value("--preset", arguments)
    hand = option_value("--hand", arguments) or None
    run_dir = option_value("--run-dir", arguments)
    resumes = not {"--resume", "--or-resume"}.isdisjoint(arguments)
    if resumes and run_dir:
        from congrasp.learner.run_directory import CONFIG_FILE, open_run

        if (pathlib.Path(run_dir) / CONFIG_FILE).exists():
            config = open_run(pathlib.Path(run_dir))
            _check_hand(run_dir, config, preset, hand)
            return {"config": config}
    config = get_preset(preset or "quickstart", hand)
    teacher = option_value("--teacher", arguments)
    if teacher:
        from congrasp.services.train.students import student_of

        method = option_value("--method", arguments)
        config = student_of(config, teacher, method if method in STUDENTS else STUDENT)
    return {"config": config}


def _check_hand(run_dir: str, config: RunConfig, preset: str, hand: str | None) -> None:
    """Raises a CongraspError for a preset of another hand than that of the run to resume."""
    if preset and get_preset(preset, hand).task.hand != config.task.hand:
        raise CongraspError(
            f"{run_dir} is a run of '{get_hand(config.task.hand).name}', which --preset "
            f"{preset} is not for.",
            "Leave out --preset, or choose another --run-dir.",
        )


COMMAND = train
