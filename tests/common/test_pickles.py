"""Arrays out of pickles and NPZ files, and those that want more than to be read."""

import functools
import io
import os
import pathlib
import pickle
import re
import threading
import zipfile

import numpy as np
import pytest
import scipy.sparse

from congrasp.common.errors import CongraspError
from congrasp.common.io import pickles
from congrasp.common.io.arrays import read_npz
from congrasp.common.io.pickles import read_pickle, read_pickles
from tests.children import python
from tests.limits import limited
from tests.mano_file import Reduced, dumps, mano_pickle, selection


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_pickles_of_python_are_read(tmp_path, protocol):
    array = np.arange(12, dtype=">f4").reshape(3, 4)
    value = {
        "numbers": [1, -2, 3.5, True],
        "words": {"a": "ü", "none": None},
        "array": array,
        "fortran": np.asfortranarray(np.arange(6, dtype=np.int16).reshape(2, 3)),
        "scalar": np.float64(2.5),
        "left out": {"set": {1, 2}, "large": 2**70, "mixed": [array, None]},
        "again": array,
    }
    path = tmp_path / "file.pkl"
    path.write_bytes(pickle.dumps(value, protocol))
    read = read_pickle(path)
    assert read.keys() == {
        "numbers",
        "words/a",
        "words/none",
        "array",
        "fortran",
        "scalar",
        "again",
    }
    for name in ("numbers", "array", "fortran", "scalar", "again"):
        np.testing.assert_array_equal(read[name], value[name])
    assert str(read["words/a"]) == "ü"
    assert read["words/none"].shape == (0,)


def test_several_files_share_a_process_and_a_bad_one_is_named(monkeypatch):
    data = [(f"{i}.pkl", pickle.dumps({"x": np.full(3, i)})) for i in range(1500)]
    read = read_pickles(data)
    assert len(read) == 1500
    assert all((arrays["x"] == i).all() for i, arrays in enumerate(read))
    data[7] = "7.pkl", pickle.dumps(print)
    with pytest.raises(CongraspError, match=r"^7\.pkl names 'builtins\.print'"):
        read_pickles(data)
    monkeypatch.setattr(pickles, "MAX_BYTES", 1000)
    with pytest.raises(CongraspError, match="exceed"):
        read_pickles(data[:7] * 20)


def test_the_process_imports_no_package_but_numpy(tmp_path):
    (tmp_path / "pickles.zip").write_bytes(b"PK\x05\x06" + bytes(18))
    listed = (
        "import runpy, sys; runpy.run_path(sys.argv.pop(1), run_name='__main__'); "
        "print(*sys.modules)"
    )
    program = pathlib.Path(pickles.__file__).with_name("unpickle.py")
    files = program, tmp_path / "pickles.zip", tmp_path / "answer.npz"
    modules = python("-c", listed, *files, 1 << 30, 10, 1 << 20).stdout.split()
    assert "numpy" in modules
    assert not {"jax", "psutil", "scipy", "zenoh"}.intersection(modules)
    ours = [name for name in modules if name.startswith("congrasp.")]
    assert ours[2:] == ["congrasp.common.runtime.platforms"], ours


def test_sparse_matrices_and_chumpys_selections_are_arrays(tmp_path):
    matrix = scipy.sparse.random(7, 5, 0.4, "csc", random_state=0)
    array = np.arange(24.0).reshape(2, 3, 4)
    chosen = selection(array[..., :2], array)
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(matrix, 2))
    (tmp_path / "b.pkl").write_bytes(dumps({"x": chosen}))
    np.testing.assert_array_equal(read_pickle(tmp_path / "a.pkl")[""], matrix.toarray())
    np.testing.assert_array_equal(read_pickle(tmp_path / "b.pkl")["x"], array[..., :2])


class _Runs:
    """Leaves a file behind if it is ever unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_hostile_pickles_are_refused_in_one_line_and_nothing_runs(tmp_path):
    mark = tmp_path / "it ran"
    deep: list = []
    for _ in range(100_000):
        deep = [deep]
    flags = Reduced("numpy dtype", ("O8", 0, 1), (3, "|", None, None, None, 8, 8, 0))
    pointers = Reduced("numpy.core.multiarray scalar", (flags, "A" * 8))
    fields = Reduced(
        "numpy dtype", ("V8", 0, 1), (3, "|", None, ("x",), {"x": (flags, 0)}, 8, 1, 0)
    )
    record = Reduced("numpy.core.multiarray _reconstruct", (), (1, (1,), fields, False, "A" * 8))
    files = {
        "call": (pickle.dumps(_Runs(mark)), "mkdir"),
        "eval": (dumps(Reduced("__builtin__ eval", ("1",))), "eval"),
        "nested": (
            dumps(
                {
                    "J": [
                        Reduced(
                            "numpy.core.multiarray _reconstruct", (), Reduced("os system", ("x",))
                        )
                    ]
                }
            ),
            "os",
        ),
        "getattr": (dumps(Reduced("__builtin__ getattr", ("", "a"))), "getattr"),
        "instance": (b"(S'true'\nios\nsystem\n.", "system"),
        "persistent": (b"Pos.system\n.", "damaged"),
        "extension": (b"\x80\x02\x82\x01.", "damaged"),
        "buffer": (b"\x80\x05\x97.", "damaged"),
        "built on a name": (b"cnumpy\nndarray\n}b.", "damaged"),
        "called twice": (b"cnumpy\nndarray\n)R)R.", "damaged"),
        "pointers": (dumps(pointers), "'O8'|damaged"),
        "record": (dumps(record), "not of numbers"),
        "lock": (dumps(Reduced("thread allocate_lock")), "allocate_lock"),
        "itself": (b"}q\x00U\x01ah\x00s.", "contains itself"),
        "deep": (b"\x80\x02" + b"}U\x01a" * 100_000 + b"N" + b"s" * 100_000 + b".", "too deeply"),
        "cut off": (mano_pickle()[:-1000], "damaged"),
        "text": (b"not a pickle", "not a pickle"),
        "empty": (b"", "not a pickle"),
        "huge number": (b"I" + b"9" * 10_000 + b"\n.", "damaged"),
        "huge string": (b"\x80\x04\x8d" + b"\xff" * 8 + b".", "damaged"),
        "shape": (
            dumps(
                Reduced(
                    "numpy.core.multiarray _reconstruct",
                    (),
                    (1, (10**9,), Reduced("numpy dtype", ("f8",)), 0, ""),
                )
            ),
            "damaged",
        ),
        "sparse": (
            dumps(
                Reduced(
                    "scipy.sparse.csc csc_matrix",
                    (),
                    {"_shape": (10**6, 10**6), "data": [], "indices": [], "indptr": []},
                )
            ),
            "damaged|memory",
        ),
    }
    before = threading.active_count()
    for name, (data, word) in files.items():
        path = tmp_path / f"{name}.pkl"
        path.write_bytes(data)
        with pytest.raises(CongraspError, match=word) as raised:
            pytest.fail(f"{name}: {read_pickle(path)}")
        assert str(path) in str(raised.value), name
        assert "\n" not in str(raised.value), name
    assert not mark.exists()
    assert threading.active_count() == before


def _laugh(levels):
    """Dictionaries each of which holds the one before it twice."""
    names = (b"U\x01ah%cU\x01bh%c" % (i, i) for i in range(levels))
    return (
        b"\x80\x02}q\x00"
        + b"".join(b"}q%c(%su" % (i + 1, name) for i, name in enumerate(names))
        + b"."
    )


_TUPLES = b"\x80\x02)" + b"".join(b"q%c0h%ch%c\x86" % (i, i, i) for i in range(40))
_NESTED = b"\x80\x02)" + b"\x85" * 200_000
_BYTES = Reduced("numpy dtype", ("u1",))
_WIDE = Reduced(
    "numpy.core.multiarray _reconstruct", (), (1, (1 << 20,), _BYTES, 0, "x" * (1 << 20))
)
_SHARED = dumps(_WIDE)[2:-1] + b"q\x01" + b"0"
_REPEATED = b"".join(b"U\x04%04dh\x01" % i for i in range(1000))
_TORCH = (
    *(0x1950A86A20F9469CFC6C, 1001, {"little_endian": True}),
    *(b"\x80\x02(X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x000tQ.", ["0"]),
)
_STORAGE = (
    b"".join(part if isinstance(part, bytes) else dumps(part) for part in _TORCH)
    + (1).to_bytes(8, "little")
    + bytes(4)
)
_TENSOR = Reduced(
    "torch._utils _rebuild_tensor_v2",
    (Reduced("torch.storage _load_from_bytes", (_STORAGE,)), 0, (600_000_000,), (0,), False, {}),
)


@pytest.mark.parametrize(
    ("data", "word"),
    [
        pytest.param(_laugh(40)[:-1] + b"U\x01xK\x01s.", "needs", id="dictionaries that repeat"),
        pytest.param(
            b"\x80\x02}" + _TUPLES[2:] + b"Ns.",
            "needs",
            id="a key of 2^40 values",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            b"\x80\x04\x8f(" + _TUPLES[2:] + b"\x90.",
            "needs",
            id="a member of them",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            b"\x80\x02}" + _NESTED[2:] + b"Ns.",
            "needs|deeply",
            id="a deep key",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            b"\x80\x02(" + b"]" * 50_000_000 + b"l.",
            "needs",
            id="many values",
            marks=pytest.mark.slow,
        ),
        pytest.param(dumps([_TENSOR]), "damaged", id="a tensor of one number"),
        pytest.param(
            b"\x80\x02" + _SHARED + b"}(" + _REPEATED + b"u.", "large|needs", id="one buffer"
        ),
    ],
)
def test_a_small_pickle_takes_little_memory_and_time(data, word, monkeypatch):
    monkeypatch.setattr(pickles, "MAX_PROCESSOR_S", 1)
    monkeypatch.setattr(pickles, "MAX_MEMORY_BYTES", 1 << 30)
    message = limited(parse, data)
    assert message.startswith("CongraspError: a.pkl"), message
    assert re.search(word, message), message


def parse(data):
    return type(read_pickles([("a.pkl", data)]))


# --- NPZ files ---


def _npy(shape, kind="<f8", body=b""):
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"
    text += " " * (63 - (len(text) + 10) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode() + body


def _zip(path, members, method=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, data)


def test_arrays_come_back(tmp_path):
    arrays = {
        "a": np.arange(6.0).reshape(2, 3),
        "b": np.array("text"),
        "c": np.asfortranarray(np.eye(3, 2)),
    }
    arrays["d"] = np.ones(0)
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    read = read_npz(tmp_path / "a.npz", "")
    assert read.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(read[name], array)
        assert read[name].flags.f_contiguous == array.flags.f_contiguous
        assert read[name].flags.writeable


@pytest.mark.parametrize(
    ("members", "why"),
    [
        pytest.param(
            {"a.npy": _npy((32 << 20,), "|u1", bytes(32 << 20))}, "4 MB", id="inflates to 32 MB"
        ),
        pytest.param(
            {f"{i}.npy": _npy((1 << 19,), "|u1", bytes(1 << 19)) for i in range(9)},
            "4 MB",
            id="nine",
        ),
        pytest.param({"a.npy": _npy((1 << 40,))}, "bytes, which is not", id="claims 8 TB"),
        pytest.param(
            {"a.npy": _npy((1 << 62, 8))}, "bytes, which is not", id="claims more than there is"
        ),
        pytest.param({"a.npy": _npy((1 << 40,), "|V0")}, "type", id="values of no size"),
        pytest.param(
            {"a.npy": _npy((1 << 40,), "<U0")}, "bytes, which is not", id="texts of no size"
        ),
        pytest.param({"a.npy": _npy((1,), "|O", b"\x80\x04N.")}, "type", id="an object"),
        pytest.param(
            {f"{i}.npy": _npy((0,)) for i in range(2000)}, "more than 1000 arrays", id="many"
        ),
        pytest.param(
            {"a.npy": b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 65535},
            "not an NPZ file",
            id="deep header",
        ),
        pytest.param({"a.txt": b""}, "members that are not arrays", id="a text"),
    ],
)
def test_an_archive_that_expands_too_far_is_refused_unread(tmp_path, members, why):
    _zip(tmp_path / "a.npz", members)
    read = functools.partial(read_npz, largest=4 << 20)
    message = limited(read, tmp_path / "a.npz", "Get it again.", memory=24 << 20)
    assert message.startswith(f"CongraspError: {tmp_path / 'a.npz'}")
    assert why in message
    assert message.endswith("Get it again.")


def test_a_directory_that_lies_about_sizes_inflates_no_further(tmp_path):
    _zip(tmp_path / "a.npz", {"a.npy": _npy((1 << 30,), "|u1", bytes(1 << 27))})
    data = (tmp_path / "a.npz").read_bytes()
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        size = archive.infolist()[0].file_size.to_bytes(4, "little")
    (tmp_path / "a.npz").write_bytes(data.replace(size, (1000).to_bytes(4, "little")))
    assert "CongraspError" in limited(read_npz, tmp_path / "a.npz", "", memory=64 << 20)
