"""Channels of JSON with schemas, and names in groups."""

import json
import math

from hypothesis import given
from hypothesis import strategies as st

from congrasp.services.record.writer import JsonChannels, flatten, nest

NAMES = st.lists(st.text("abc_", min_size=1, max_size=3), min_size=1, max_size=3).map("/".join)


@given(st.dictionaries(NAMES, st.floats(allow_nan=False), max_size=8))
def test_flatten_undoes_nest(values: dict[str, float]) -> None:
    assert flatten(nest(values)) == values


def test_a_name_may_also_be_a_group() -> None:
    assert nest({"loss": 1.0, "loss/value": 2.0}) == {"loss": {"": 1.0, "value": 2.0}}


def test_numbers_that_json_lacks_are_left_out() -> None:
    entry = JsonChannels().entry(
        "/m", 5, {"a": 1.0, "b": math.nan, "c": {"d": math.inf, "e": 2}, "f": True}
    )
    assert json.loads(entry.data) == {"a": 1.0, "c": {"e": 2}, "f": True}
    assert entry.time == 5


def test_schema_grows_with_new_fields_and_keeps_the_old() -> None:
    channels = JsonChannels()
    first = channels.entry("/metrics/learner/0", 0, {"update": 0, "values": {"kl": 0.1}}).channel
    again = channels.entry("/metrics/learner/0", 1, {"update": 1, "values": {"kl": 0.2}}).channel
    grown = channels.entry(
        "/metrics/learner/0", 2, {"values": {"success": 0.5}, "name": "x"}
    ).channel
    assert first is again
    assert json.loads(grown.schema) == {
        "type": "object",
        "properties": {
            "update": {"type": "number"},
            "values": {
                "type": "object",
                "properties": {"kl": {"type": "number"}, "success": {"type": "number"}},
            },
            "name": {"type": "string"},
        },
    }
    assert grown.topic == first.topic
    assert grown.schema_name == first.schema_name


def test_topics_have_schemas_of_their_own() -> None:
    channels = JsonChannels()
    names = {
        channels.entry(topic, 0, {"a": 1}).channel.schema_name
        for topic in ("/metrics/actor/a", "/metrics/actor/b")
    }
    assert len(names) == 2
