"""Counts of a running decomposition."""

import pytest

from congrasp.services.assets.objects.cut_progress import (
    CUTTING,
    JOINING,
    Count,
    pieces_in,
    read_count,
    write_joins,
)
from congrasp.services.assets.objects.decompose import decompose
from tests.solids import ell


def log_of(*pools):
    """CoACD's log of iterations with these numbers of waiting parts."""
    lines = [f"[info] iter {i} ---- waiting pool: {size}" for i, size in pools]
    return "\n".join(["[info]  - Decomposition (MCTS)", *lines, "[info] Processing [50.0%]"])


@pytest.mark.parametrize(
    ("pools", "counts"),
    [
        ((), (0, 0)),
        (((0, 1),), (0, 1)),
        # Of four parts three are cut, so that one is finished.
        (((0, 1), (1, 2), (2, 4), (3, 6)), (1, 7)),
        # The second body begins when the two parts of the first one are finished.
        (((0, 1), (1, 2), (0, 1), (1, 2)), (2, 4)),
    ],
)
def test_pieces_are_counted_in_the_log(pools, counts):
    assert pieces_in(log_of(*pools).encode()) == counts


def test_joins_are_counted_after_the_cut(tmp_path):
    assert read_count(tmp_path) == Count(CUTTING, 0, 0)
    (tmp_path / "log.txt").write_text(log_of((0, 1), (1, 2), (2, 2)))
    assert read_count(tmp_path) == Count(CUTTING, 1, 3)
    write_joins(tmp_path, 2, 9)
    assert read_count(tmp_path) == Count(JOINING, 2, 9)


def test_a_decomposition_reports_its_counts():
    mesh = ell()
    counts = []

    def progress(*count):
        counts.append(Count(*count))

    decompose(mesh.vertices, mesh.faces, volume=mesh.volume, progress=progress)
    assert counts[0] == Count(CUTTING, 0, 0)
    assert counts[-1].activity in (CUTTING, JOINING)
    assert counts[-1].done > 0
    for count in counts:
        assert count.done <= count.total
