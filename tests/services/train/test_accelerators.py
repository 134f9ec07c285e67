"""GPUs that a command distributes its work over."""

import pytest

from congrasp.services.train import accelerators
from congrasp.services.train.accelerators import Gpus, Hardware, several_gpus


@pytest.fixture
def machine(monkeypatch, tmp_path):
    """Simulates a machine with GPUs; returns the list of searches for them by JAX."""
    searches = []

    def make(count):
        for number in range(count):
            (tmp_path / f"nvidia{number}").touch()
        (tmp_path / "nvidiactl").touch()
        monkeypatch.setattr(accelerators, "DEVICES", tmp_path)

        def detect():
            searches.append(count)
            return Hardware("gpu", count, "Card 9000")

        monkeypatch.setattr(accelerators, "detect", detect)
        return searches

    return make


@pytest.mark.parametrize("physics", ["auto", "warp"])
def test_several_gpus_are_named(machine, monkeypatch, physics):
    machine(3)
    assert several_gpus(physics) == Gpus(("0", "1", "2"), "Card 9000")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,GPU-7,1")
    assert several_gpus(physics) == Gpus(("4", "GPU-7", "1"), "Card 9000")


@pytest.mark.parametrize(("count", "physics"), [(0, "auto"), (1, "auto"), (2, "native")])
def test_without_use_for_several_gpus_none_is_searched(machine, count, physics):
    searches = machine(count)
    assert several_gpus(physics) is None
    assert not searches


def test_gpus_without_a_driver_of_jax_are_not_used(machine, monkeypatch):
    machine(2)
    monkeypatch.setattr(accelerators, "detect", lambda: Hardware("cpu", 1, "cpu"))
    assert several_gpus("auto") is None
