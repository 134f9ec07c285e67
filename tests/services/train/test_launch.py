"""`launch.json`, from which the processes of `congrasp train` take their options."""

import dataclasses
import json
import pathlib
from types import ModuleType
from typing import Any

import pytest

from congrasp.common.errors import CongraspError
from congrasp.learner.run_directory import create_run
from congrasp.services.cli import actor, learner, main, parser
from congrasp.services.train.launch import (
    Launch,
    LaunchRecord,
    LearnerOptions,
    read_launch,
    write_launch,
)
from congrasp.services.train.presets import get_preset


def make_record(**changes: object) -> LaunchRecord:
    """Two ranks with two actors each; every option differs from its default."""
    options = LearnerOptions(insecure=True, metric_writers=(), audit=False)
    launch = Launch(
        actors=2, ranks=2, certs=pathlib.Path("certs"), metrics_port=9100, learner=options
    )
    record = LaunchRecord(
        run="mug", endpoint="tcp/0.0.0.0:7000", actors=2, physics="native", launch=launch
    )
    return dataclasses.replace(record, **changes)


def parsed(role: ModuleType, *arguments: object) -> dict[str, Any]:
    """Values of a command's parameters."""
    parse = parser.of_command(role.COMMAND, "congrasp", role.defaults)
    return parse([str(word) for word in arguments]).keywords


def test_launch_file_round_trip(tmp_path):
    record = make_record()
    assert read_launch(write_launch(tmp_path, record)) == record


def test_launched_learner_takes_options_of_file(tmp_path):
    config = get_preset("quickstart", None)
    create_run(tmp_path, config)
    path = write_launch(tmp_path, make_record())
    first = parsed(learner, "--launch", path, "--rank", 0)
    second = parsed(learner, "--launch", path, "--rank", 1)
    options = first["options"]
    assert options == learner.Options(
        run_dir=tmp_path,
        launch=path,
        listen="tcp/0.0.0.0:7000",
        certs=pathlib.Path("certs"),
        resume=True,
        ranks=2,
        coordinator="127.0.0.1:7008",
        shared=LearnerOptions(insecure=True, metric_writers=(), audit=False),
    )
    assert first["config"] == config
    assert second["options"] == dataclasses.replace(options, rank=1)
    ports = [values["watch"].metrics_port for values in (first, second)]
    assert ports == [9100, 0], "two processes cannot share the port"


@pytest.mark.parametrize("audit", [True, False])
def test_launched_actor_takes_options_of_file(tmp_path, audit):
    record = make_record()
    options = dataclasses.replace(record.launch.learner, audit=audit)
    launch = dataclasses.replace(record.launch, learner=options)
    path = write_launch(tmp_path, dataclasses.replace(record, launch=launch))
    values = parsed(actor, "--launch", path, "--id", "actor-3")
    assert values["launch"] == path
    assert values["connect"] == "tcp/127.0.0.1:7004", "the second actor of rank 1"
    assert values["run"] == "mug"
    assert values["id"] == "actor-3"
    assert values["physics"] == "native"
    assert values["certs"] == pathlib.Path("certs")
    assert values["no_audit"] is not audit
    journal = tmp_path / "audit" / "actor-3.jsonl"
    assert values["audit"] == (journal if audit else None)
    assert values["references"].parent == tmp_path / "references"


@pytest.mark.parametrize("audit", [True, False])
@pytest.mark.parametrize("option", ["--no-audit", "--audit=mine.jsonl"])
def test_launched_actor_overrides_audit(tmp_path, audit, option):
    record = make_record()
    options = dataclasses.replace(record.launch.learner, audit=audit)
    launch = dataclasses.replace(record.launch, learner=options)
    path = write_launch(tmp_path, dataclasses.replace(record, launch=launch))
    values = parsed(actor, "--launch", path, "--id", "actor-3", option)
    assert values["no_audit"] is (option == "--no-audit")
    assert values["audit"] == (None if option == "--no-audit" else pathlib.Path("mine.jsonl"))


def edited(record: LaunchRecord, **changes: object) -> str:
    content = json.loads(json.dumps(dataclasses.asdict(record), default=str))
    return json.dumps({**content, **changes})


DAMAGES = {
    "missing": None,
    "empty": "",
    "list": "[]",
    "newer format": edited(make_record(), format=2),
    "unknown option": edited(make_record(), speed=1),
    "wrong type": edited(make_record(), actors="two"),
}


@pytest.mark.parametrize("content", DAMAGES.values(), ids=DAMAGES)
@pytest.mark.parametrize("role", ["learner", "actor"])
def test_unreadable_launch_file_is_one_line(tmp_path, capsys, role, content):
    path = tmp_path / "launch.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(SystemExit) as end:
        main.main([role, "--launch", str(path)])
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert str(path) in line


@pytest.mark.parametrize(
    ("option", "value"),
    [("actors", -1), ("ranks", 0), ("metrics_port", -5), ("metrics_port", 65536)],
)
def test_launch_out_of_range_is_refused(option, value):
    launch = dataclasses.replace(Launch(), **{option: value})
    with pytest.raises(CongraspError, match=f"--{option.replace('_', '-')} is {value}"):
        launch.planned(get_preset("check"))


def test_launch_file_without_actor_names_those_it_has():
    with pytest.raises(CongraspError, match="actor-0, actor-1, actor-2, actor-3"):
        make_record().learner_of_actor("actor-4")
