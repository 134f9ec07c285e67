"""Files as strangers have them: each folder of `tests/cases` is run by its command, and says what
was wrong.

`case.json` of a folder:

* `command`, run in a copy of the folder, as after `congrasp`, and `status`, its exit code.
* `says`, patterns in what it prints, and `never`, patterns that are not in it.
* `objects`: the objects in `out` by name, with `size_cm`, `mass_g`, most `pieces` and their
  `volume_cm3`, `parts`, and `outwards` for normals that point away from the middle, where they
  matter.
* `files`: further inputs by name: a `text`, a `copy` of another case's, or one `from` `_hand` with
  `replace`, what comes `before` it, and its `encoding`.
* `sign` and `remedy`: a row of the page "My file does not load".
* `full`: shapes are cut as for users, which takes seconds.

`make.py` writes binary inputs. A case is added by adding a folder.
"""

import contextlib
import json
import os
import pathlib
import re
import shlex
import shutil
from typing import Any

import numpy as np
import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.objects import shapes, store
from congrasp.common.runtime.confinement import Limits
from congrasp.services.arm.description import load_arm
from congrasp.services.assets.confined import EnvironmentFailure, call_confined
from congrasp.services.assets.hands import model_files, reading
from congrasp.services.assets.hands.model_files import import_hand
from congrasp.services.assets.hands.reading import FaultyFile
from congrasp.services.assets.hands.robot_texts import read_texts
from congrasp.services.cli import main
from congrasp.services.viz import hand_sheets
from tests.services.conftest import quick_imports

ROOT = pathlib.Path(__file__).parents[3]
CASES = ROOT / "tests" / "cases"
PROGRESS = re.compile(r": \d+ s so far\.$")
"""A line that a slow machine adds after some seconds."""
NAMES = sorted(folder.parent.name for folder in CASES.glob("*/case.json"))


def prepared(name: str, folder: pathlib.Path) -> dict[str, Any]:
    """Copies a case to a folder, with the inputs that it makes from others; returns its
    description.
    """
    shutil.copytree(CASES / name, folder, dirs_exist_ok=True)
    case = json.loads((folder / "case.json").read_text())
    for file, how in case.get("files", {}).items():
        if "copy" in how:
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(CASES / how["copy"], folder / file)
            continue
        text = how["text"] if "text" in how else (CASES / "_hand" / how["from"]).read_text()
        for old, new in how.get("replace", {}).items():
            assert old in text, f"{name}: {old}"
            text = text.replace(old, new)
        if "before" in how:
            text = (
                how["before"] + text.partition("?>")[2]
                if text.startswith("<?xml")
                else how["before"] + text
            )
        (folder / file).write_bytes(text.encode(how.get("encoding", "utf-8")))
    return case


@contextlib.contextmanager
def here(function, path, options):
    """Does what a confined process does in this one, which is faster."""
    yield function(path.resolve().parent, str(path), **options), path.resolve().parent


@pytest.mark.parametrize("name", NAMES)
def test_a_case_ends_as_it_should(name, tmp_path, monkeypatch, capsys):
    case = prepared(name, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(model_files, "confined", here)
    monkeypatch.setattr(hand_sheets, "joints_sheet", lambda hand: np.zeros((4, 4, 3), np.uint8))
    with contextlib.nullcontext() if case.get("full") else quick_imports():
        try:
            status = main.run(shlex.split(case["command"]))
        except CongraspError as error:
            print(error)
            status = error.exit_code
    printed = capsys.readouterr()
    lines = (printed.out + printed.err).splitlines(keepends=True)
    output = "".join(line for line in lines if not PROGRESS.search(line))
    assert status == case["status"], output
    for pattern in case["says"]:
        assert re.search(pattern, output, re.DOTALL), output
    for pattern in case.get("never", ()):
        assert not re.search(pattern, output), output
    assert "Traceback" not in output
    assert "Warning" not in output
    assert "\x1b" not in output
    if status == 2:
        assert len(output.splitlines()) == 1, output
    objects = {path.stem: store.load(path) for path in (tmp_path / "out").glob("*.safetensors")}
    assert objects.keys() == case.get("objects", objects).keys()
    for key, facts in case.get("objects", {}).items():
        obj = objects[key]
        if "size_cm" in facts:
            np.testing.assert_allclose(
                100 * np.ptp(obj.visual_vertices, axis=0), facts["size_cm"], atol=0.01
            )
        if "mass_g" in facts:
            assert 1000 * obj.mass == pytest.approx(facts["mass_g"], rel=0.01)
        if "pieces" in facts:
            assert len(obj.pieces) <= facts["pieces"]
            assert obj.shape_reliable
        if "outwards" in facts:
            assert (obj.normals * obj.points).sum(-1).min() > 0
        if "parts" in facts:
            assert list(obj.part_names) == facts["parts"]
        if "volume_cm3" in facts:
            assert 1e6 * sum(shapes.volume(piece) for piece in obj.pieces) == pytest.approx(
                facts["volume_cm3"], rel=0.2
            )
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


@pytest.mark.parametrize("name", ["hand_plain", "hand_swapped"])
def test_a_confined_process_reads_the_same(name, tmp_path):
    prepared(name, tmp_path)
    messages = []
    for read in (import_hand, model_files.propose):
        try:
            proposal = read(tmp_path / "hand.urdf")
            messages.append((proposal.hand, proposal.palm, proposal.notes, sorted(proposal.meshes)))
        except CongraspError as error:
            messages.append(str(error))
    assert messages[0] == messages[1]


def test_a_description_that_takes_all_time_or_memory_is_refused(tmp_path, monkeypatch):
    """By the processor time of the confined process, however busy the machine is."""
    monkeypatch.setattr(reading, "SECONDS", 2)
    geom = '<body><geom size="0.1"/></body>'
    nested = '<replicate count="999">' * 3 + geom + "</replicate>" * 3
    (tmp_path / "a.xml").write_text(f"<mujoco><worldbody>{nested}</worldbody></mujoco>")
    for read in (import_hand, load_arm):
        with pytest.raises(
            CongraspError, match=r"a\.xml cannot be read: .* the limits are 2 s and 3 GB"
        ):
            read(tmp_path / "a.xml")
    large = (
        '<mujoco><asset><hfield name="a" nrow="40000" ncol="40000" size="1 1 1 '
        '1"/></asset></mujoco>'
    )
    (tmp_path / "a.xml").write_text(large)
    with pytest.raises(
        CongraspError, match=r"a\.xml cannot be read: .* more than 3 GB\. Cut the hand out"
    ):
        import_hand(tmp_path / "a.xml")


def test_a_pipe_among_the_files_of_a_description_is_not_opened(tmp_path):
    prepared("hand_include", tmp_path)
    (tmp_path / "more.xml").unlink()
    os.mkfifo(tmp_path / "more.xml")
    with pytest.raises(
        CongraspError, match=r"'more\.xml' that it names is no regular file\. Name one"
    ):
        model_files.propose(tmp_path / "hand.xml")


@pytest.mark.parametrize(
    ("texts", "pipe"),
    [
        (['<texture type="cube" fileright="a.png" fileleft="pipe"/>'], "pipe"),
        (
            [
                '<compiler meshdir="meshes"/><include file="sub/more.xml"/>',
                '<asset><mesh file="pipe"/></asset>',
            ],
            "meshes/pipe",
        ),
        (
            [
                '<asset><model file="sub/more.xml"/></asset>',
                '<compiler meshdir="meshes"/><asset><mesh file="pipe"/></asset>',
            ],
            "sub/meshes/pipe",
        ),
    ],
    ids=["second attribute", "include", "attached model"],
)
def test_pipes_are_recognised_wherever_mujoco_searches(tmp_path, texts, pipe):
    for name, text in zip(("hand.xml", "sub/more.xml"), texts, strict=False):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(f"<mujoco>{text}</mujoco>")
    (tmp_path / pipe).parent.mkdir(exist_ok=True)
    os.mkfifo(tmp_path / pipe)
    with pytest.raises(FaultyFile, match="'pipe' that it names is no regular file"):
        read_texts(tmp_path / "hand.xml")


@pytest.mark.parametrize("count", [300, 301])
def test_the_number_of_included_files_is_limited(tmp_path, count):
    names = [f"{number}.xml" for number in range(count)]
    for name in names:
        (tmp_path / name).write_text("<mujoco/>")
    includes = "".join(f'<include file="{name}"/>' for name in names)
    (tmp_path / "hand.xml").write_text(f"<mujoco>{includes}</mujoco>")
    if count > 300:
        with pytest.raises(ValueError, match="more than 300 files"):
            read_texts(tmp_path / "hand.xml")
        return
    assert list(read_texts(tmp_path / "hand.xml").included) == names


def test_an_answer_that_cannot_be_written_is_an_environment_error(tmp_path):
    """As on a full disk: a folder has the name of the answer's file."""
    (tmp_path / "answer.json").mkdir()
    limits = Limits(memory=1 << 30, processor_s=30.0, patience_s=300.0)
    with pytest.raises(EnvironmentFailure, match=r"^failed \(IsADirectoryError: "):
        call_confined(os.path.basename, tmp_path, {}, limits)
