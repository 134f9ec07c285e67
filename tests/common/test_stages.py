import time

import jax
import pytest

from congrasp.common.runtime import stages


@pytest.fixture(autouse=True)
def _none_yet(monkeypatch):
    monkeypatch.setattr(stages, "_stages", {})


def test_stages_are_in_the_order_of_their_begin_and_only_the_first_of_a_name_counts(caplog):
    caplog.set_level("INFO", "congrasp")
    stages.imported()
    with stages.stage("outer"), stages.stage("inner"):
        time.sleep(0.02)
    kept = stages.stages()
    with stages.stage("inner"):
        pass
    assert [one.name for one in kept] == ["imports", "outer", "inner"]
    assert stages.stages() == kept
    outer, inner = kept[1:]
    assert outer.began <= inner.began
    assert inner.ended <= outer.ended
    assert inner.ended - inner.began >= 0.02
    assert [record.getMessage().split()[1] for record in caplog.records] == [
        "imports",
        "inner",
        "outer",
    ]


def test_long_work_of_jax_on_a_program_is_a_stage(monkeypatch):
    monkeypatch.setattr(stages, "_PROGRAM_SECONDS", 0.0)
    stages.imported()
    jax.jit(_program)(1.0)
    assert {"trace _program", "lower _program", "compile or read _program"} <= {
        one.name for one in stages.stages()
    }


def _program(x):
    return x + 1


def test_a_stage_that_fails_is_noted_all_the_same():
    with pytest.raises(ValueError), stages.stage("failing"):
        raise ValueError
    assert [one.name for one in stages.stages()] == ["failing"]
