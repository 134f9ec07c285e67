"""Division of rows into common batches, with a simulator that returns what it was given."""

import types
from typing import NamedTuple

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from congrasp.services.evaluate.common_batches import run_rows
from congrasp.services.evaluate.episodes import Sample


class Conditions(NamedTuple):
    """Fields of initial conditions (B,) that the simulator reads."""

    hold: np.ndarray
    region: np.ndarray


class Simulator:
    """Returns the regions of its episodes."""

    def __init__(self, batch):
        self.batch = batch
        self.runs = 0

    def run(self, conditions, *, stressed, progress):
        assert len(conditions.hold) == self.batch
        self.runs += 1
        progress(0.5)
        forces = np.repeat(conditions.region[:, None, None], 2, axis=2)
        sample = Sample({"success": conditions.region}, forces, forces)
        return types.SimpleNamespace(sample=sample)


@given(
    lengths=st.lists(st.integers(1, 20), min_size=1, max_size=6),
    batch=st.integers(1, 16),
)
def test_every_row_gets_its_own_episodes_in_their_order(lengths, batch):
    regions = np.split(np.arange(sum(lengths)), np.cumsum(lengths)[:-1])
    rows = [Conditions(np.ones(len(region), int), region) for region in regions]
    simulator = Simulator(batch)
    progress = []
    samples = run_rows(simulator, rows, stressed=True, progress=progress.append)
    for sample, region in zip(samples, regions, strict=True):
        np.testing.assert_array_equal(sample.values["success"], region)
        np.testing.assert_array_equal(sample.link_force[:, 0, 0], region)
    assert simulator.runs == -(-sum(lengths) // batch)
    assert progress == sorted(progress)
    assert progress[-1] == sum(lengths)
