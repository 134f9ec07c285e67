"""The record that `congrasp hands import --json` writes."""

import json
import pathlib

import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.files import hand_sha256
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.services.assets.hands.import_record import read_import
from congrasp.services.cli import main

CLAW = pathlib.Path(__file__).parents[3] / "hands" / "claw.urdf"


def test_the_record_of_an_import_describes_the_hand_of_its_file(tmp_path):
    record_file = tmp_path / "hands" / "import.json"
    hand_file = tmp_path / "claw.json"
    options = ["--name", "mine", "--out", str(hand_file), "--json", str(record_file)]
    assert main.run(["hands", "import", str(CLAW), *options]) == 0
    record = read_import(record_file)
    hand = get_hand(str(hand_file))
    assert record.hand == "mine"
    assert record.hand_sha256 == hand_sha256(hand)
    assert record.joints == len(hand.joints)
    assert record.motors == len(hand.motors)
    assert record.links == len(hand.links)
    assert [finger[-1] for finger in record.fingers] == [hand.links[i].name for i in hand.tip_links]
    assert record.fingers[0][-1] == hand.thumb
    assert record.opening_mm == pytest.approx(1000 * grasp_frame(hand).opening, abs=0.1)
    assert record.object_scale == hand.object_scale
    # A part of a record is an error that names the file and the command
    content = json.loads(record_file.read_text())
    del content["motors"]
    record_file.write_text(json.dumps(content))
    with pytest.raises(CongraspError, match=r"import\.json is not the record.*'motors'.*--json"):
        read_import(record_file)


def test_the_hash_of_a_hand_depends_on_its_content_alone(tmp_path):
    fields = json.loads(CLAW.with_suffix(".json").read_text())
    hashes = []
    for number, changes in enumerate([{}, {"object_scale": 0.5}]):
        for indent in (1, 3):
            file = tmp_path / f"{number}-{indent}.json"
            file.write_text(json.dumps({**fields, **changes}, indent=indent))
            hashes.append(hand_sha256(get_hand(str(file))))
    assert hashes[0] == hashes[1]
    assert hashes[2] == hashes[3]
    assert hashes[1] != hashes[2]
