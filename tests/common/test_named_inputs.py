"""Files and folders that a run names: absolute paths, and the same content everywhere."""

import dataclasses
import shutil

import pytest

from congrasp.common.config import (
    DistillConfig,
    ObjectsConfig,
    RunConfig,
    run_config_from_json,
    to_json,
)
from congrasp.common.errors import CongraspError
from congrasp.common.named_inputs import KINDS, OF_ACTORS, check_inputs, identified
from congrasp.learner.run_directory import continue_run, create_run, open_run

FILES = {
    "objects": "o/box.safetensors",
    "constraints": "s/box.constraints.safetensors",
    "teacher": "t.safetensors",
}
REMEDY = "Copy it to {path}."


@pytest.fixture
def config(tmp_path, monkeypatch):
    """A run that names all kinds of files by relative paths."""
    monkeypatch.chdir(tmp_path)
    for name in (*FILES.values(), "initial.safetensors"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(name)
    return RunConfig(
        objects=ObjectsConfig(folder="o", constraints="s"),
        distill=DistillConfig(teacher="t.safetensors"),
    )


def test_paths_become_absolute_and_survive_json(config, tmp_path):
    named = identified(config, tmp_path / "initial.safetensors")
    assert named.objects.folder == str(tmp_path / "o")
    assert named.distill.teacher == str(tmp_path / "t.safetensors")
    assert [each.kind for each in named.inputs] == [*FILES, "initial"]
    assert run_config_from_json(to_json(named)) == named
    check_inputs(named.inputs, KINDS, REMEDY)


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("damage", ["changed", "missing", "more"])
def test_other_content_is_refused_by_name(config, tmp_path, kind, damage):
    named = identified(config)
    path = tmp_path / FILES[kind]
    if damage == "changed":
        path.write_text("else")
    elif damage == "missing":
        path.unlink()
    else:
        path.with_name(f"more-{path.name}").write_text("more")
    if damage == "more" and kind == "teacher":
        check_inputs(named.inputs, KINDS, REMEDY)
        return
    with pytest.raises(CongraspError, match=f"run's configuration names .*{tmp_path}.*Copy it"):
        check_inputs(named.inputs, KINDS, REMEDY)


def test_files_of_other_kinds_do_not_matter(config, tmp_path):
    named = identified(config)
    (tmp_path / "o" / "notes.txt").write_text("notes")
    (tmp_path / "t.safetensors").unlink()  # actors do not read it
    check_inputs(named.inputs, OF_ACTORS, REMEDY)


@pytest.mark.parametrize("kind", FILES)
def test_resume_with_other_content_is_refused(config, tmp_path, kind):
    create_run(tmp_path / "run", identified(config))
    (tmp_path / FILES[kind]).write_text("else")
    with pytest.raises(CongraspError, match=r"run's configuration names .*start another run"):
        continue_run(tmp_path / "run", open_run(tmp_path / "run"))


def test_resume_from_elsewhere_with_moved_content_is_accepted(config, tmp_path, monkeypatch):
    create_run(tmp_path / "run", identified(config))
    shutil.move(tmp_path / "o", tmp_path / "elsewhere")
    monkeypatch.chdir(tmp_path / "s")
    before = open_run(tmp_path / "run")
    objects = dataclasses.replace(before.objects, folder="../elsewhere")
    after = continue_run(tmp_path / "run", dataclasses.replace(before, objects=objects))
    assert after.objects.folder == str(tmp_path / "elsewhere")
    assert open_run(tmp_path / "run") == after


def test_resume_of_an_earlier_version_learns_the_content(config, tmp_path):
    create_run(tmp_path / "run", config)
    assert [each.kind for each in continue_run(tmp_path / "run", config).inputs] == [*FILES]


def test_resume_with_another_initial_policy_is_refused(config, tmp_path):
    initial = tmp_path / "initial.safetensors"
    create_run(tmp_path / "run", identified(config, initial))
    before = open_run(tmp_path / "run")
    continue_run(tmp_path / "run", before, initial)
    initial.write_text("else")
    with pytest.raises(CongraspError, match="the initial policy"):
        continue_run(tmp_path / "run", before, initial)
