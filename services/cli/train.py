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
    """Train a policy: one learner and its actors on this machine, which exchange messages over
    Zenoh on the loopback interface.

    The configuration is that of a preset, and every field of it can be set on the command line.
    `--preset full --hand HAND` trains any hand on the full task, with one recipe for all hands. The
    presets human, allegro and sharpa are short for this with these hands.

    Args:
      config: Configuration of the run.
      launch: Processes of the run.
      preset: Configuration to start from: quickstart, full, human, allegro or sharpa. The preset
        check does not train a useful policy: it tests physics, messages, log, server and pictures
        on this machine.
      method: Method whose settings are used: ours (the full method), a baseline or ablation of the
        paper (graspxl, dgrasp, no-dynamic-center, no-feedforward, two-phase, single-stage), or a
        policy for robots (student: with an object tracker; camera: with a depth camera). By default
        the method of the preset, which is ours.
      hand: The hand: its name ('congrasp hands list') or its file ('congrasp hands import'). By
        default the hand of the preset.
      run_dir: Folder of the run; runs/NAME-DATE by default.
      initial: Policy whose weights replace the random initial weights: `policy.safetensors` of a
        run, or a policy of the package. Its networks must have the sizes of the run. A policy of
        the package has no critic, so the critic starts from random weights.
      teacher: Policy to distil into a student: a policy file, or the hand of a pretrained policy.
        The student observes the joints, the wrist and object poses from a tracker, but neither
        forces nor velocities (docs/students.md). With `--method camera` it observes a partial point
        cloud (docs/camera.md). The task is the teacher's, and the algorithm is `distill`.
      constraints: Folder of constraint sets to train with, such as captured ones ('congrasp
        constraints import'). --objects.folder holds their objects, and --objects.procedural adds
        objects of the generator.
      split: Part of these sets to use: training (the default), held-out, or all.
      resume: Resume from the newest intact checkpoint in --run-dir, with the configuration of the
        run; options that only the learner uses, such as --updates and --ppo.…, may be changed.
      evaluation: Number of episodes of the evaluation after training, on held-out objects. By
        default 192, or three times --environments if that is less. 0 skips the evaluation.

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
            f"{run_dir} is a run of the hand '{get_hand(config.task.hand).name}', but --preset "
            f"{preset} is for another hand.",
            "Leave out --preset, or choose another --run-dir.",
        )


COMMAND = train
