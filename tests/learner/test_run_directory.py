"""A run goes on with the configuration that it began with, but for what the learner alone uses."""

import dataclasses

import pytest

from common.errors import CongraspError
from learner.run_directory import continue_run, create_run, open_run
from services.cli.train import defaults
from services.train.presets import get_preset


@pytest.fixture
def run(tmp_path):
    config = dataclasses.replace(get_preset("quickstart"), environments=3, updates=7)
    create_run(tmp_path / "run", config)
    return tmp_path / "run", config


def test_what_the_learner_alone_uses_may_change_and_is_kept(run):
    folder, config = run
    changed = dataclasses.replace(config, updates=9, ppo=dataclasses.replace(config.ppo, clip=0.1))
    continue_run(folder, changed)
    assert open_run(folder) == changed


@pytest.mark.parametrize("change", [{"environments": 4}, {"rollout_steps": 5}, {"name": "other"}, {"algorithm": "a2c"}])
def test_what_actors_use_may_not(run, change):
    folder, config = run
    with pytest.raises(CongraspError, match=rf"'{next(iter(change))}' that it began with. Begin .*--initial"):
        continue_run(folder, dataclasses.replace(config, **change))
    assert open_run(folder) == config


def test_a_command_line_that_resumes_starts_from_the_runs_own_configuration(run):
    folder, config = run
    assert defaults(["--resume", "--run-dir", str(folder)]) == {"preset": "quickstart", "config": config}
    assert defaults([f"--run-dir={folder}", "--or-resume", "--preset", "human"])["config"] == config
    assert defaults(["--run-dir", str(folder), "--preset=human"]) == {"preset": "human", "config": get_preset("human")}
    assert defaults(["--or-resume", "--run-dir", str(folder / "none")])["config"] == get_preset("quickstart")
