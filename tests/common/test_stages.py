import time

import pytest

from congrasp.common.runtime import stages


@pytest.fixture(autouse=True)
def _none_yet(monkeypatch):
    monkeypatch.setattr(stages, "_stages", {})


def test_stages_are_in_the_order_of_their_begin_and_only_the_first_of_a_name_counts():
    stages.imported()
    with stages.stage("outer"), stages.stage("inner"):
        time.sleep(0.02)
    kept = stages.stages()
    with stages.stage("inner"):
        pass
    assert [one.name for one in kept] == ["imports", "outer", "inner"]
    assert stages.stages() == kept
    outer, inner = kept[1:]
    assert outer.began <= inner.began and inner.ended <= outer.ended
    assert inner.ended - inner.began >= 0.02


def test_a_stage_that_fails_is_noted_all_the_same():
    with pytest.raises(ValueError), stages.stage("failing"):
        raise ValueError
    assert [one.name for one in stages.stages()] == ["failing"]
