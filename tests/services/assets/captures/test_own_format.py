"""A format of one's own: a file and its row in `IMPORTERS`, and nothing else."""

import numpy as np
import pytest

from congrasp.common.errors import CongraspError
from congrasp.services.assets.captures import IMPORTERS
from congrasp.services.assets.captures.human import joint_positions
from congrasp.services.cli.main import load
from tests.services.assets.captures import known


def test_an_importer_from_outside_needs_a_file_and_a_row(run_import, tmp_path, monkeypatch):
    monkeypatch.setitem(IMPORTERS, "own", "tests.services.assets.captures.own_format")
    case = known.make("box_lift", "box")
    (tmp_path / "data").mkdir()
    arrays = {
        "wrist_position": case.wrist_position,
        "wrist_rotation": case.wrist_rotation.as_matrix(),
        "joints": joint_positions(case.fingers),
        "object_position": case.object_position,
        "object_rotation": case.object_rotation.as_matrix(),
        "present": np.ones(known.FRAMES, bool),
    }
    np.savez(tmp_path / "data" / "box_lift.capture.npz", **arrays)
    np.savez(tmp_path / "data" / "cup_lift.capture.npz", **arrays)
    known.write_mesh(case, tmp_path / "meshes" / "box.stl")
    sets, report = run_import("own", tmp_path / "data", "--meshes", tmp_path / "meshes")
    assert [row["sequence"] for row in report.kept] == ["box_lift"]
    assert sets["box"].meta["source"] == "own"
    known.check(sets["box"].arrays, 0, case)
    assert [(row["sequence"], row["rule"]) for row in report.dropped] == [("cup_lift", "no mesh")]
    (tmp_path / "empty").mkdir()
    with pytest.raises(
        CongraspError, match=r"contains no sequence of own.*folder with \*\.capture\.npz"
    ):
        load("constraints")(["import", "own", str(tmp_path / "empty")])()


def test_an_unknown_format_is_refused_with_those_that_there_are(tmp_path):
    with pytest.raises(CongraspError, match=r"no format 'nobodys'.*grab, oakink, dexycb, myohand"):
        load("constraints")(["import", "nobodys", str(tmp_path)])()
