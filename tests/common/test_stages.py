"""Stages of a process's start."""

import time

import jax
import pytest

from congrasp.common.runtime import stages as module
from tests.modules import fresh_copy


@pytest.fixture
def stages():
    """The module without any stage."""
    return fresh_copy(module)


def names(stages):
    return [stage.name for stage in stages.stages()]


def test_stages_are_ordered_by_their_begin(stages):
    stages.record_import_stage()
    with stages.stage("outer"), stages.stage("inner"):
        time.sleep(0.02)
    assert names(stages) == ["imports", "outer", "inner"]
    _, outer, inner = stages.stages()
    assert outer.began <= inner.began
    assert inner.ended <= outer.ended
    assert inner.ended - inner.began >= 0.02


def test_a_repeated_stage_is_ignored(stages):
    with stages.stage("loading"):
        pass
    first = stages.stages()
    with stages.stage("loading"):
        pass
    assert stages.stages() == first


def test_stages_are_logged_at_their_end(stages, caplog):
    caplog.set_level("INFO", "congrasp")
    stages.record_import_stage()
    with stages.stage("outer"), stages.stage("inner"):
        pass
    logged = [record.getMessage().split()[1] for record in caplog.records]
    assert logged == ["imports", "inner", "outer"]


def test_long_work_of_jax_on_a_program_is_a_stage(stages, monkeypatch):
    monkeypatch.setattr(stages, "PROGRAM_SECONDS", 0.0)
    stages.record_import_stage()
    jax.jit(_program)(1.0)
    assert {"trace _program", "lower _program", "compile or read _program"} <= set(names(stages))


def _program(x):
    return x + 1


def test_a_failed_stage_is_recorded(stages):
    with pytest.raises(ValueError), stages.stage("failing"):
        raise ValueError
    assert names(stages) == ["failing"]


def test_stages_of_another_process_are_those_of_its_last_start(stages, caplog, tmp_path):
    caplog.set_level("INFO", "congrasp")
    stages.record_import_stage(ended_s=3.0)
    lines = [record.getMessage() for record in caplog.records]
    lines.append("Start: programs took 2.0 s, until 6.0 s after the start of the process.")
    lines.append("Start: trace _advance took 0.5 s, until 5.0 s after the start of the process.")
    log = tmp_path / "actor-0.log"
    log.write_text("\n".join(["info: " + line for line in [*lines, "Died.", *lines]]))
    logged = stages.logged_stages(log, 10.0)
    assert logged == [("imports", 10.0, 13.0), ("programs", 14.0, 16.0)]


def test_stages_of_an_absent_log_are_none(stages, tmp_path):
    assert stages.logged_stages(tmp_path / "actor-0.log", 0.0) == []
