"""Arrays out of pickles, and pickles that want more than to be read."""

import collections
import os
import pickle
import re
import threading

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st

from congrasp.common.errors import CongraspError
from congrasp.common.io.pickles import parse_pickle, read_pickle
from tests.limits import limited
from tests.mano_file import Reduced, content, dumps, mano_pickle, selection


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_what_python_writes_comes_back(tmp_path, protocol):
    value = {
        "numbers": [1, -2, 3.5, 2**70, True, None],
        "words": ("a", "ü", b"\x00\xff"),
        "array": np.arange(12, dtype=">f4").reshape(3, 4),
        "fortran": np.asfortranarray(np.arange(6, dtype=np.int16).reshape(2, 3)),
        "scalar": np.float64(2.5),
        "set": {1, 2},
    }
    value["again"] = value["array"]
    path = tmp_path / "file.pkl"
    path.write_bytes(pickle.dumps(value, protocol))
    read = read_pickle(path)
    assert read["numbers"] == value["numbers"] and read["set"] == {1, 2}
    assert read["words"] == value["words"]
    for name in ("array", "fortran", "again"):
        np.testing.assert_array_equal(read[name], value[name])
    assert read["scalar"] == 2.5 and read["again"] is read["array"]


def test_sparse_matrices_and_chumpys_selections_are_arrays(tmp_path):
    matrix = scipy.sparse.random(7, 5, 0.4, "csc", random_state=0)
    whole = np.arange(24.0).reshape(2, 3, 4)
    chosen = selection(whole[..., :2], whole)
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(matrix, 2))
    (tmp_path / "b.pkl").write_bytes(dumps({"x": chosen}))
    np.testing.assert_array_equal(read_pickle(tmp_path / "a.pkl"), matrix.toarray())
    np.testing.assert_array_equal(read_pickle(tmp_path / "b.pkl")["x"], whole[..., :2])


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
    kind = Reduced("numpy dtype", ("O8", 0, 1), (3, "|", None, None, None, -1, -1, 63))
    array = Reduced("numpy.core.multiarray _reconstruct", (), (1, (1,), kind, False, ["x"]))
    files = {
        "call": (pickle.dumps(_Runs(mark)), "mkdir"),
        "eval": (dumps(Reduced("__builtin__ eval", ("1",))), "eval"),
        "nested": (
            dumps({"J": [Reduced("numpy.core.multiarray _reconstruct", (), Reduced("os system", ("x",)))]}),
            "os",
        ),
        "getattr": (dumps(Reduced("__builtin__ getattr", ("", "a"))), "getattr"),
        "instance": (b"(S'true'\nios\nsystem\n.", "INST"),
        "persistent": (b"Pfile\n.", "PERSID"),
        "extension": (b"\x80\x02\x82\x01.", "EXT1"),
        "buffer": (b"\x80\x05\x97.", "NEXT_BUFFER"),
        "built on a name": (b"cnumpy\nndarray\n}b.", "damaged"),
        "called twice": (b"cnumpy\nndarray\n)R)R.", "no name"),
        "objects": (dumps(array), "not of numbers"),
        "mappings": (pickle.dumps(collections.OrderedDict(a=1)), "OrderedDict"),
        "lock": (dumps(Reduced("thread allocate_lock")), "allocate_lock"),
        "itself": (b"]q\x00h\x00a.", "contains itself"),
        "deep": (b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b".", "too deeply"),
        "cut off": (mano_pickle()[:-1000], "cut off|damaged"),
        "text": (b"not a pickle", "pickle|damaged"),
        "empty": (b"", "cut off"),
        "huge number": (b"I" + b"9" * 10_000 + b"\n.", "damaged"),
        "huge string": (b"\x80\x04\x8d" + b"\xff" * 8 + b".", "damaged|pickle"),
        "shape": (
            dumps(
                Reduced("numpy.core.multiarray _reconstruct", (), (1, (10**9,), Reduced("numpy dtype", ("f8",)), 0, ""))
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
            "sparse",
        ),
    }
    before = threading.active_count()
    for name, (data, word) in files.items():
        path = tmp_path / f"{name}.pkl"
        path.write_bytes(data)
        with pytest.raises(CongraspError, match=word) as raised:
            read_pickle(path)
        assert str(path) in str(raised.value) and "\n" not in str(raised.value), name
    assert not mark.exists() and threading.active_count() == before


def _laugh(levels):
    """Lists each of which holds the one before it twice."""
    return b"\x80\x02]q\x00" + b"".join(b"]q%c(h%ch%ce" % (i + 1, i, i) for i in range(levels)) + b"."


def test_shared_parts_are_turned_once(tmp_path):
    (tmp_path / "shared.pkl").write_bytes(_laugh(10))
    value = read_pickle(tmp_path / "shared.pkl")
    assert value[0] is value[1]


_TUPLES = b"\x80\x02)" + b"".join(b"q%c0h%ch%c\x86" % (i, i, i) for i in range(40))
_NESTED = b"\x80\x02)" + b"\x85" * 200_000
_BYTES = Reduced("numpy dtype", ("u1",))
_WIDE = Reduced("numpy.core.multiarray _reconstruct", (), (1, (1 << 20,), _BYTES, 0, "x" * (1 << 20)))
_TORCH = (
    *(0x1950A86A20F9469CFC6C, 1001, {"little_endian": True}),
    *(b"\x80\x02(X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x000tQ.", ["0"]),
)
_STORAGE = (
    b"".join(part if isinstance(part, bytes) else dumps(part) for part in _TORCH) + (1).to_bytes(8, "little") + bytes(4)
)
_TENSOR = Reduced(
    "torch._utils _rebuild_tensor_v2",
    (Reduced("torch.storage _load_from_bytes", (_STORAGE,)), 0, (600_000_000,), (0,), False, {}),
)


@pytest.mark.parametrize(
    ("data", "word"),
    [
        pytest.param(_laugh(40), "repeats its values", id="lists that repeat"),
        pytest.param(b"\x80\x02}" + _TUPLES[2:] + b"Ns.", "keys", id="a key of 2^40 values"),
        pytest.param(b"\x80\x04\x8f(" + _TUPLES[2:] + b"\x90.", "keys", id="a member of 2^40 values"),
        pytest.param(b"\x80\x02}" + _NESTED[2:] + b"Ns.", "keys", id="a deep key"),
        pytest.param(_NESTED + b".", "too deeply", id="deep tuples"),
        pytest.param(b"\x80\x02(" + b"]" * 2_000_000 + b"l.", "opcodes", id="many values"),
        pytest.param(dumps([_TENSOR]), "arrays", id="a tensor of one number"),
        pytest.param(
            b"\x80\x02](" + dumps(_WIDE)[2:-2] + b"q\x01" + b"h\x01" * 4000 + b"e.", "arrays|repeats", id="one buffer"
        ),
    ],
)
def test_a_small_pickle_takes_little_memory_and_time(data, word):
    said = limited(parse_mixed, data)
    assert said.startswith("CongraspError: a.pkl") and re.search(word, said), said


def parse_mixed(data):
    return type(parse_pickle(data, "a.pkl", mixed=True))


_MANO = mano_pickle({name: value for name, value in content().items() if name in ("J", "shapedirs", "all_directions")})


@settings(max_examples=60, deadline=None)
@given(st.integers(0, len(_MANO) - 1), st.binary(min_size=1, max_size=4))
def test_whatever_a_file_says_it_is_read_or_refused(tmp_path_factory, at, noise):
    path = tmp_path_factory.getbasetemp() / "noise.pkl"
    path.write_bytes(_MANO[:at] + noise + _MANO[at + len(noise) :])
    try:
        read_pickle(path)
    except CongraspError as error:
        assert str(path) in str(error)
