"""Arrays out of pickles, and pickles that want more than to be read."""

import collections
import os
import pickle
import threading

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st

from common.errors import CongraspError
from common.pickles import read_pickle
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


def test_shared_parts_are_turned_once(tmp_path):
    """Forty lists, each of which holds the one before it twice, would be 2^40 values."""
    data = b"\x80\x02]q\x00" + b"".join(b"]q%c(h%ch%ce" % (i + 1, i, i) for i in range(40)) + b"."
    (tmp_path / "laugh.pkl").write_bytes(data)
    value = read_pickle(tmp_path / "laugh.pkl")
    assert value[0] is value[1]


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
