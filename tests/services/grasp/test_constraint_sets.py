"""Constraint sets: content of the files, and the two commands."""

import dataclasses

import numpy as np
import pytest
from PIL import Image

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.closure import outline
from congrasp.common.objects import store
from congrasp.common.task.sampling import set_file, sets
from congrasp.common.task.sampling.headings import Headings
from congrasp.common.task.sampling.reach import within_reach
from congrasp.common.wire.codec import Message
from congrasp.services.cli.main import load
from congrasp.services.grasp.parse import read_request
from tests.task import HAND, OBJECTS, bank

BOX, _, MUG, _ = OBJECTS


@pytest.fixture(scope="module")
def file(constraint_sets, tmp_path_factory):
    """Constraint set of the mug."""
    return set_file.save(constraint_sets[2], tmp_path_factory.mktemp("sets"))


def test_every_array_is_described_and_has_the_described_shape(constraint_sets):
    for constraints in constraint_sets:
        arrays = constraints.arrays
        meta = constraints.meta
        assert set(arrays) == set(meta["arrays"])
        sizes: dict[str, int] = {"V": 2, "F": len(meta["finger_joints"]), "H": 256, "M": 20}
        for name, words in meta["arrays"].items():
            letters = words[1 : words.index(")")].replace(",", " ").split()
            assert len(letters) == arrays[name].ndim, name
            for letter, size in zip(letters, arrays[name].shape, strict=True):
                assert size == (
                    int(letter) if letter.isdigit() else sizes.setdefault(letter, size)
                ), name
        assert get_hand(meta["hand_reference"]) is HAND
        assert meta["finger_joints"][0] == HAND.joints[0].name
        assert meta["quaternions"] == "(w, x, y, z)"


def test_a_set_equals_the_bank_of_training(constraint_sets):
    trained = bank()
    for n, constraints in enumerate(constraint_sets):
        arrays = constraints.arrays
        np.testing.assert_array_equal(arrays["heading/position"], trained.heading_position[n])
        np.testing.assert_array_equal(arrays["pose/q"], trained.pose_q[n])
        rest = arrays["rest"]
        assert len(np.unique(rest, axis=0)) == len(rest) <= trained.rest.shape[1]
        headings = Headings(*(arrays[f"heading/{name}"][0] for name in Headings._fields))
        all_cleared, reachable = within_reach(headings, OBJECTS[n], rest, outline(HAND))
        np.testing.assert_array_equal(arrays["heading/allowed"][0], reachable)
        for r, cleared in enumerate(all_cleared):
            moved = np.linalg.norm(cleared.position - headings.position, axis=-1)
            allowed = arrays["heading/allowed"][0, r]
            np.testing.assert_allclose(
                arrays["heading/back"][0, r][allowed], moved[allowed], atol=1e-6
            )
        np.testing.assert_allclose(
            arrays["trajectory/position"][:, :, -1], arrays["pose/position"], atol=1e-4
        )


def test_files_round_trip(constraint_sets, file):
    read = set_file.load(file)
    assert file.name == "mug_2.constraints.safetensors"
    assert dict(read.meta) == dict(constraint_sets[2].meta)
    for name, array in constraint_sets[2].arrays.items():
        np.testing.assert_array_equal(read.arrays[name], array)


def test_show_prints_and_draws_a_file(file, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("congrasp.services.viz.constraint_sheet.SIZE", (48, 36))
    picture = tmp_path / "sheet.png"
    assert load("constraints")(["show", str(file), "--png", str(picture)])() == 0
    words = capsys.readouterr().out
    assert "human, 20 finger joints" in words
    assert "mug_2" in words
    assert "resting pose 1" in words
    colours = np.asarray(Image.open(picture).convert("RGB")).reshape(-1, 3).astype(int)
    red, _, blue = colours.T
    assert (blue - red > 60).sum() > 20  # arrows
    assert (red - blue > 100).sum() > 100  # the object
    with pytest.raises(CongraspError, match="--rest is 99"):
        load("constraints")(["show", str(file), "--rest", "99"])()


def test_generate_takes_names_files_and_families(tmp_path, monkeypatch):
    names = []
    monkeypatch.setattr(
        sets,
        "make_sets",
        lambda hand, task, objects, seed, bank: names.extend(obj.name for obj in objects) or [],
    )
    store.Catalogue(tmp_path / "objects").add(BOX)
    folder = ["--folder", str(tmp_path / "objects"), "--out", str(tmp_path / "sets")]
    file = tmp_path / "crate.safetensors"
    store.save(dataclasses.replace(BOX, name="crate"), file)
    arguments = ["box_0", "mug:7", str(file), "--count", "1", "--families", "ball"]
    assert load("constraints")(["generate", *arguments, *folder])() == 0
    assert names == ["box_0", "mug_7", "crate", "ball_0"]
    with pytest.raises(CongraspError, match="no objects for which to generate constraints"):
        load("constraints")(["generate"])()
    with pytest.raises(CongraspError, match="no object 'nothing'"):
        load("constraints")(["generate", "nothing", *folder])()


def test_a_reference_is_refused_for_another_object_or_size(constraint_sets, file, tmp_path):
    request = read_request(MUG, HAND, 15, pose=f"{file}:3")
    np.testing.assert_array_equal(
        request.given("pose", "q"), constraint_sets[2].arrays["pose/q"][0, 3]
    )
    with pytest.raises(
        CongraspError, match=r"is for an object of .* cm, .*; 'box_0' has .*set of this"
    ):
        read_request(BOX, HAND, 15, trajectory=str(file))
    larger = Message(constraint_sets[2].arrays, {**constraint_sets[2].meta, "object_scale": 1.4})
    file = set_file.save(larger, tmp_path)
    with pytest.raises(
        CongraspError,
        match=r"human hand is trained on objects 1\.4 times as large: add --scale 1\.4",
    ):
        read_request(MUG.scaled(1 / 1.4), HAND, 15, pose=str(file))
