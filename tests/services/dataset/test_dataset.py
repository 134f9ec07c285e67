"""Datasets of grasps: the same shards whoever makes them, in whichever order, killed or not; and
what they say.
"""

import concurrent.futures
import hashlib
import json
import os
import pathlib
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
import psutil
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import congrasp.services.cli.main as cli
from congrasp.actors import stress
from congrasp.common import rotations
from congrasp.common.errors import CongraspError
from congrasp.common.objects.procedural import generate
from congrasp.services.assets.objects.named import objects_at
from congrasp.services.dataset.shards import CARD
from congrasp.services.evaluate import plan
from congrasp.services.train.accelerators import Gpus
from tests.waits import eventually

ROOT = pathlib.Path(__file__).resolve().parents[3]


def arguments(out: pathlib.Path, *more: str) -> list[str]:
    """Four episodes of each of two objects, a shard each, in batches of three and one."""
    options = [
        "dataset",
        "box:2-3",
        "--out",
        str(out),
        "--per-object",
        "4",
        "--shard",
        "1",
        "--batch",
        "3",
    ]
    return [
        *options,
        "--constraints",
        "heading",
        "affordance",
        "--keep",
        "all",
        "--physics",
        "native",
        *more,
    ]


def made(out: pathlib.Path, *more: str) -> dict:
    """Makes a dataset in this process, which compiles once for all of them; returns its card."""
    assert not cli.run(arguments(out, *more))
    return json.loads((out / CARD).read_text())


def contents(folder: pathlib.Path) -> dict[str, bytes]:
    """Bytes of the shards."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*.parquet"))
    }


def loader() -> Callable:
    """The loader of the documentation."""
    code = re.search(r"```python\n(.*?)```", (ROOT / "docs" / "datasets.md").read_text(), re.S)
    namespace: dict = {}
    exec(code[1], namespace)
    return namespace["batches"]


@pytest.fixture(scope="module")
def short_protocol():
    """Holds and pushes that last an eighth and a twelfth of their time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "REQUIRED_HOLD_S", 0.25)
        patch.setattr(stress, "PUSH_S", 0.02)
        yield


@pytest.fixture(scope="module")
def dataset(tmp_path_factory, short_protocol) -> pathlib.Path:
    """A dataset that was made at once."""
    out = tmp_path_factory.mktemp("dataset")
    made(out)
    return out


@pytest.fixture(scope="module")
def columns(dataset) -> dict[str, np.ndarray]:
    """Its grasps."""
    batches = [dict(batch) for batch in loader()(dataset, size=3)]
    assert max(len(batch["q"]) for batch in batches) <= 3
    columns = {}
    for name in batches[0]:
        columns[name] = np.concatenate([batch[name] for batch in batches])
    return columns


@pytest.mark.slow
def test_a_killed_run_and_parts_make_the_same_shards(tmp_path_factory, tmp_path, monkeypatch):
    monkeypatch.setattr(plan, "REQUIRED_HOLD_S", 2.0)  # as in the process
    monkeypatch.setattr(stress, "PUSH_S", 0.25)
    made(dataset := tmp_path_factory.mktemp("whole"))
    command = [sys.executable, "-m", "congrasp", *arguments(tmp_path)]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    eventually(lambda: len(contents(tmp_path)) >= 2 or process.poll() is not None, 0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.wait(30)
    killed = contents(tmp_path)
    assert 2 <= len(killed) < 4, "it was killed between its first shard and its last"
    (tmp_path / "grasps" / f".00001-of-00002.parquet.{process.pid}.tmp").write_bytes(
        b"half a shard"
    )
    first = sorted(tmp_path.rglob("*.parquet"))[0]
    changed = first.stat().st_mtime_ns
    made(tmp_path, "--part", "2/2")
    card = made(tmp_path)
    assert first.stat().st_mtime_ns == changed, "what was finished is not made again"
    assert contents(tmp_path) == contents(dataset)
    assert card["counts"] == json.loads((dataset / CARD).read_text())["counts"]
    assert card["shards"] == {"finished": 2, "of": 2}


@pytest.fixture
def two_cards(monkeypatch):
    """Simulates a machine with two GPUs, on which the engine runs on the CPU as before."""
    gpus = Gpus(("0", "1"), "Card 9000")
    monkeypatch.setattr("congrasp.services.train.accelerators.several_gpus", lambda physics: gpus)


@pytest.mark.slow
def test_several_gpus_make_the_same_shards(tmp_path_factory, tmp_path, monkeypatch, request):
    monkeypatch.setattr(plan, "REQUIRED_HOLD_S", 2.0)  # as in the processes
    monkeypatch.setattr(stress, "PUSH_S", 0.25)
    alone = made(dataset := tmp_path_factory.mktemp("whole"))
    request.getfixturevalue("two_cards")
    card = made(tmp_path)
    assert contents(tmp_path) == contents(dataset)
    assert card["counts"] == alone["counts"]
    assert card["shards"] == {"finished": 2, "of": 2}
    assert card["machine"].endswith(", 2 x Card 9000")
    assert card["command"] == alone["command"]


def test_a_killed_process_of_a_gpu_ends_the_command(two_cards, tmp_path):
    this = psutil.Process()
    before = this.children()

    def workers():
        return [child for child in this.children() if child not in before]

    def kill_one():
        eventually(lambda: len(workers()) == 2, 0.01)
        workers()[0].kill()

    with concurrent.futures.ThreadPoolExecutor() as pool:
        killed = pool.submit(kill_one)
        with pytest.raises(CongraspError, match=r"The process of GPU \d ended"):
            made(tmp_path)
        killed.result()
    assert not workers()
    assert not (tmp_path / CARD).exists()


def test_rows_have_requests_and_outcomes(dataset, columns):
    card = json.loads((dataset / CARD).read_text())
    assert len(columns["object"]) == 8
    assert sorted(set(columns["object"])) == ["box_2", "box_3"]
    for constraint in ("heading", "affordance"):
        rows = columns["constraints"] == constraint
        assert sorted(columns["episode"][rows]) == [0, 0, 1, 1]
        assert card["counts"][constraint]["episodes"] == 4
        assert card["counts"][constraint]["held"] == columns["held"][rows].sum()
        assert np.isnan(columns["goal_heading_direction"][rows]).all() == (constraint != "heading")
        assert np.isfinite(columns["affordance_ratio"][rows]).all() == (constraint == "affordance")
    assert (columns["held"] >= columns["lifted"]).all()
    assert (columns["lifted"] >= columns["pushed"]).all()
    assert columns["held"].any()
    unit = np.linalg.norm(
        columns["goal_heading_direction"][columns["constraints"] == "heading"], axis=-1
    )
    np.testing.assert_allclose(unit, 1.0, atol=1e-5)


def test_poses_are_in_the_frame_of_the_object(columns):
    """A held object has its surface at the hand: the wrist is as far from it as the hand is long,
    not metres.
    """
    held = columns["held"]
    assert np.linalg.norm(columns["wrist"][held, :3], axis=-1).max() < 0.35
    assert (columns["object_pose"][held, 2] > 0).all()
    start = columns["start_object"]
    turned = rotations.rotate(jnp.asarray(start[:, 3:]), jnp.asarray(columns["start_wrist"][:, :3]))
    assert (np.asarray(turned + start[:, :3])[:, 2] > 0).all(), "the wrist starts above the table"


def test_objects_are_stored(dataset):
    table = pq.read_table(dataset / "objects")
    box = generate(2, "box")
    row = table.column("object").to_pylist().index("box_2")
    np.testing.assert_allclose(table.column("mass")[row].as_py(), box.mass, rtol=1e-6)
    np.testing.assert_allclose(
        np.reshape(table.column("points")[row].as_py(), (512, 3)), box.points, atol=1e-6
    )


def test_only_requested_outcomes_are_kept_and_all_are_counted(dataset, columns, tmp_path):
    card = made(tmp_path, "--keep", "held", "clean", "--part", "1/2")
    of_first = columns["object"] == "box_2"
    is_kept = of_first & columns["held"] & columns["clean"]
    assert pq.read_table(tmp_path / "grasps").num_rows == is_kept.sum()
    counted = card["counts"].values()
    assert sum(counts["episodes"] for counts in counted) == of_first.sum()
    assert sum(counts["kept"] for counts in counted) == is_kept.sum()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--seed", "1"), "another dataset: its seed is 0, not 1.*--out"),
        (("--batch", "1"), "its batch is 3, not 1"),
        (("--part", "4/3"), "--part is '4/3'"),
        (("--constraints", "levitation"), "levitation"),
        (("--shard", "100000"), "--shard"),
    ],
)
def test_bad_options(dataset, more, words):
    with pytest.raises(CongraspError, match=words) as error:
        cli.run(arguments(dataset, *more))
    assert "\n" not in str(error.value)


def test_a_damaged_file_is_named_and_a_missing_one_is_made_again(dataset, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(dataset, folder)
    card = made(folder)
    grasps = folder / "grasps" / "00001-of-00002.parquet"
    assert card["sha256"] == {
        name: hashlib.sha256(data).hexdigest() for name, data in contents(dataset).items()
    }
    data = grasps.read_bytes()
    for place in range(0, len(data), len(data) // 16):
        grasps.write_bytes(data[:place] + bytes(200) + data[place + 200 :])
        with pytest.raises(CongraspError, match=r"00001-of-00002\.parquet is damaged"):
            made(folder)
    with pytest.raises(OSError, match=r"CRC|checksum"):
        grasps.write_bytes(data[:2000] + bytes(2000) + data[4000:])
        list(loader()(folder))
    grasps.write_bytes(data)
    (folder / "objects" / grasps.name).unlink()
    assert made(folder) == card
    assert contents(folder) == contents(dataset)


def test_a_range_of_the_generator_is_many_objects():
    objects = objects_at(pathlib.Path("all:5-7"))
    assert [one.load().name for one in objects] == [one.name for one in objects]
    assert len(objects) == 3
    assert len({one.digest() for one in objects}) == 3
    with pytest.raises(CongraspError, match="is below the first"):
        objects_at(pathlib.Path("box:7-5"))


def rename_column(table: pa.Table) -> pa.Table:
    return table.rename_columns({"start_q": "start_r"})


def drop_column(table: pa.Table) -> pa.Table:
    return table.drop_columns(["start_q"])


def add_column(table: pa.Table) -> pa.Table:
    return table.append_column("start_r", table.column("mass"))


def change_field(table: pa.Table, field: pa.Field) -> pa.Table:
    number = table.schema.get_field_index("start_q")
    return table.cast(table.schema.set(number, field))


def lose_metadata(table: pa.Table) -> pa.Table:
    return change_field(table, table.schema.field("start_q").remove_metadata())


def change_unit(table: pa.Table) -> pa.Table:
    facts = {b"meaning": b"deg, finger joints at the start"}
    field = table.schema.field("start_q")
    return change_field(table, field.with_metadata({**field.metadata, **facts}))


def change_shape(table: pa.Table) -> pa.Table:
    field = table.schema.field("start_q")
    return change_field(table, field.with_metadata({**field.metadata, b"shape": b"[1]"}))


COLUMN_CHANGES = [rename_column, drop_column, add_column, lose_metadata, change_unit, change_shape]


def change_columns(shard: pathlib.Path, change: Callable[[pa.Table], pa.Table]) -> None:
    table = pq.ParquetFile(shard).read()
    changed = change(table).replace_schema_metadata(table.schema.metadata)
    pq.write_table(changed, shard, compression="zstd", write_page_checksum=True)


@pytest.fixture
def copied(dataset, tmp_path) -> pathlib.Path:
    """A copy of the dataset that a test may damage."""
    return pathlib.Path(shutil.copytree(dataset, tmp_path / "copy"))


def refused(folder: pathlib.Path, shard: pathlib.Path) -> None:
    """Asserts that the command names the shard in one line, and changes no file."""
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(CongraspError, match=re.escape(str(shard))) as error:
        made(folder)
    assert "\n" not in str(error.value)
    assert "elete it" in str(error.value)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("change", COLUMN_CHANGES)
def test_changed_columns_are_refused(copied, change):
    shard = copied / "grasps" / "00001-of-00002.parquet"
    change_columns(shard, change)
    (copied / CARD).unlink()
    refused(copied, shard)


@pytest.mark.parametrize("change", COLUMN_CHANGES)
def test_loader_refuses_changed_columns(copied, change):
    change_columns(copied / "grasps" / "00001-of-00002.parquet", change)
    with pytest.raises(ValueError, match=r"00001-of-00002\.parquet"):
        list(loader()(copied))


@pytest.mark.parametrize("kind", ["grasps", "objects"])
def test_flipped_bit_is_refused(copied, kind):
    """The bit is in the name of the file's writer, which no checksum of a page covers."""
    shard = copied / kind / "00001-of-00002.parquet"
    data = bytearray(shard.read_bytes())
    data[data.rindex(b"parquet-cpp")] ^= 1
    shard.write_bytes(data)
    refused(copied, shard)


def test_other_content_is_refused(copied):
    """A readable shard with another value is not the one in the card."""
    shard = copied / "objects" / "00000-of-00002.parquet"
    change_columns(shard, lambda table: table.slice(0, 0))
    refused(copied, shard)


def test_deleted_shard_may_differ_when_remade(copied):
    """The card forgets a deleted shard before it is made, even if the run is then killed."""
    shard = copied / "grasps" / "00001-of-00002.parquet"
    content = shard.read_bytes()
    shard.unlink()
    assert len(made(copied, "--part", "1/2")["sha256"]) == 2
    shard.write_bytes(content)
    change_columns(shard, lambda table: table.slice(0, 1))
    assert made(copied)["sha256"][f"grasps/{shard.name}"] == sha256(shard)
    change_columns(shard, lambda table: table.slice(0, 0))
    refused(copied, shard)


def test_damaged_card_is_refused(copied):
    card = copied / CARD
    card.write_bytes(card.read_bytes()[:100])
    refused(copied, card)


def sha256(file: pathlib.Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
