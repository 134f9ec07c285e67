"""NPZ files that claim more than they are."""

import functools
import io
import zipfile

import numpy as np
import pytest

from congrasp.common.io.inputs import read_npz
from tests.limits import limited


def _npy(shape, kind="<f8", body=b""):
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"
    text += " " * (63 - (len(text) + 10) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode() + body


def _zip(path, members, method=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, data)


def test_arrays_come_back(tmp_path):
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.array("text"), "c": np.asfortranarray(np.eye(3, 2))}
    arrays["d"] = np.ones(0)
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    read = read_npz(tmp_path / "a.npz", "")
    assert read.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(read[name], array)
        assert read[name].flags.f_contiguous == array.flags.f_contiguous and read[name].flags.writeable


@pytest.mark.parametrize(
    ("members", "why"),
    [
        pytest.param({"a.npy": _npy((32 << 20,), "|u1", bytes(32 << 20))}, "4 MB", id="inflates to 32 MB"),
        pytest.param({f"{i}.npy": _npy((1 << 19,), "|u1", bytes(1 << 19)) for i in range(9)}, "4 MB", id="nine"),
        pytest.param({"a.npy": _npy((1 << 40,))}, "bytes, which is not", id="claims 8 TB"),
        pytest.param({"a.npy": _npy((1 << 62, 8))}, "bytes, which is not", id="claims more than there is"),
        pytest.param({"a.npy": _npy((1 << 40,), "|V0")}, "type", id="values of no size"),
        pytest.param({"a.npy": _npy((1 << 40,), "<U0")}, "bytes, which is not", id="texts of no size"),
        pytest.param({"a.npy": _npy((1,), "|O", b"\x80\x04N.")}, "type", id="an object"),
        pytest.param({f"{i}.npy": _npy((0,)) for i in range(2000)}, "more than 1000 arrays", id="many"),
        pytest.param({"a.npy": b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 65535}, "not an NPZ file", id="deep header"),
        pytest.param({"a.txt": b""}, "else than arrays", id="a text"),
    ],
)
def test_what_is_larger_than_it_looks_is_refused_before_it_is_in_memory(tmp_path, members, why):
    _zip(tmp_path / "a.npz", members)
    read = functools.partial(read_npz, largest=4 << 20)
    said = limited(read, tmp_path / "a.npz", "Get it again.", memory=24 << 20)
    assert said.startswith(f"CongraspError: {tmp_path / 'a.npz'}") and why in said and said.endswith("Get it again.")


def test_a_directory_that_lies_about_sizes_inflates_no_further(tmp_path):
    _zip(tmp_path / "a.npz", {"a.npy": _npy((1 << 30,), "|u1", bytes(1 << 27))})
    data = (tmp_path / "a.npz").read_bytes()
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        size = archive.infolist()[0].file_size.to_bytes(4, "little")
    (tmp_path / "a.npz").write_bytes(data.replace(size, (1000).to_bytes(4, "little")))
    assert "CongraspError" in limited(read_npz, tmp_path / "a.npz", "", memory=64 << 20)
