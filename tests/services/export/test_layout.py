"""A layout shows what is in the recording."""

import itertools
import json
import pathlib
from typing import Any

import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.wire.codec import Message
from congrasp.services.export.layout import export_layout
from congrasp.services.record.converter import Converter
from congrasp.services.record.reader import read_records
from congrasp.services.record.writer import LogWriter, flatten
from tests.episodes import episode_message


def record(folder: pathlib.Path, *messages: tuple[str, Message]) -> pathlib.Path:
    convert = Converter()
    writer = LogWriter(folder, "log")
    for number, (key, message) in enumerate(messages):
        writer.write(*convert(f"congrasp/run/log/{key}", message, 10**15 + number))
    writer.close()
    return folder


def panels(content: dict[str, Any]) -> list[dict[str, Any]]:
    if content["type"] == "panel":
        return [content]
    return list(itertools.chain(*(panels(item["content"]) for item in content["items"])))


def test_every_topic_and_field_of_a_layout_is_in_the_recording(tmp_path: pathlib.Path) -> None:
    values = {
        "episode/success": 0.5,
        "episode/return": 3.0,
        "steps_per_second": 9.0,
        "kl": 0.01,
        "other": 1.0,
    }
    record(
        tmp_path / "logs",
        ("episode/actor/actor-0", episode_message()),
        ("episode/actor/b", episode_message()),
        ("metrics/learner/0", Message({}, {"time": 0.0, "update": 1, "values": values})),
        ("metrics/actor/actor-0", Message({}, {"time": 0.0, "values": {"version": 1.0}})),
        ("event/learner/0", Message({}, {"time": 0.0, "level": "info", "text": "hello"})),
    )
    count = export_layout(tmp_path / "logs", tmp_path / "layout.json")
    layout_panels = panels(json.loads((tmp_path / "layout.json").read_text())["content"])
    assert count == len(layout_panels)
    fields: dict[str, set[str]] = {}
    for file in (tmp_path / "logs").iterdir():
        for entry in read_records(file):
            recorded = fields.setdefault(entry.topic, set())
            if entry.encoding == "json":
                recorded |= {path.replace("/", ".") for path in flatten(json.loads(entry.data))}
    kinds = [panel["panelType"] for panel in layout_panels]
    assert kinds.count("ThreeDee") == 1
    assert kinds.count("Log") == 1
    assert kinds.count("Plot") == 5
    for panel in layout_panels:
        config = panel["config"]
        topics = [
            *config.get("topics", {}),
            *([config["topicToRender"]] if "topicToRender" in config else []),
        ]
        assert set(topics) <= set(fields)
        for series in config.get("paths", []):
            topic, _, field = series["value"].partition(".")
            assert field in fields[topic], series
    (scene,) = [panel["config"] for panel in layout_panels if panel["panelType"] == "ThreeDee"]
    assert {f"/episode/{actor}/scene" for actor in ("actor-0", "b")} <= set(scene["topics"])


def test_a_recording_with_nothing_to_show_is_an_error(tmp_path: pathlib.Path) -> None:
    record(
        tmp_path / "logs",
        ("event/learner/0", Message({}, {"time": 0.0, "level": "info", "text": "hello"})),
    )
    with pytest.raises(CongraspError, match="neither episodes nor metrics"):
        export_layout(tmp_path / "logs", tmp_path / "layout.json")
