"""Child process of `common.io.pickles`: unpickles with an allow-list, under limits, and answers
with arrays.

    python unpickle.py PICKLES ANSWER MEMORY SECONDS BYTES

PICKLES is a ZIP archive whose members are pickles, ANSWER the NPZ file to write. Each pickle's
number is printed before it is read, followed by the reason if it is refused. Only NumPy and
the limits are imported, so that the process starts fast.

Every class that a pickle may name is a stand-in. NumPy's own `dtype.__setstate__` takes its flags
from the file, which turns bytes into pointers.
"""

import contextlib
import io
import pickle
import re
import sys
import zipfile
from collections.abc import Iterator
from typing import Any, BinaryIO

import numpy as np

from congrasp.common.runtime.platforms import limit_this_process

_NUMBER = re.compile(r"[<>=|]?(\?|[biuf]\d{1,2})")
_TORCH_MAGIC = 0x1950A86A20F9469CFC6C


class _Part:
    """Object of a pickle: its arguments, and the state set later."""

    arguments: tuple[Any, ...]
    state: Any = None

    def __new__(cls, *arguments: Any) -> "_Part":
        self = super().__new__(cls)
        self.arguments = arguments
        return self

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Array(_Part):
    """A NumPy array: version, shape, dtype, order and data."""


class _Dtype(_Part):
    """A NumPy dtype: its name, and the byte order in the state."""


class _Sparse(_Part):
    """A SciPy matrix or array: its subclass names the form."""


_SPARSE = {form: type(form, (_Sparse,), {}) for form in ("csc", "csr", "coo")}


class _Variable(_Part):
    """A variable of chumpy."""


class _Selection(_Part):
    """Elements of another variable of chumpy."""


def _dtype(kind: Any) -> np.dtype[Any]:
    """Dtype of booleans, integers or floats."""
    name = str(kind.arguments[0])
    if not _NUMBER.fullmatch(name):
        raise pickle.UnpicklingError(f"has an array of {name[:20]!r}, not of numbers")
    is_big_endian = bool(kind.state) and kind.state[1] == ">"
    return np.dtype(name).newbyteorder(">" if is_big_endian else "<")


def _encode(text: str, _: str) -> bytes:
    """Bytes that Python 3 wrote as Latin-1 text, for protocols without bytes."""
    return text.encode("latin-1")


def _numbers(data: Any, kind: Any, shape: Any, order: str) -> np.ndarray:
    """Array of a buffer, which Python 2 wrote as text."""
    buffer = data.encode("latin-1") if isinstance(data, str) else data
    flat = np.frombuffer(buffer, _dtype(kind))
    return flat.reshape(tuple(shape), order="F" if order == "F" else "C")


def _scalar(kind: Any, data: Any) -> Any:
    """One number."""
    return _numbers(data, kind, (1,), "C")[0]


def _rebuilt(kind: Any, *_: Any) -> Any:
    """Object that protocols 0 and 1 make without `__new__`."""
    return kind()


def _storage(data: bytes) -> np.ndarray:
    """Numbers of a PyTorch storage in the format before version 1.6, which pickled tensors still
    use.

    Five pickles follow one another (a magic number, a version, facts about the machine, a reference
    to the storage and the keys of all storages), then the number of elements as an integer of eight
    bytes, and the elements.
    """
    stream = io.BytesIO(data)
    magic, _, machine, dtype, keys = (_StorageUnpickler(stream).load() for _ in range(5))
    if magic != _TORCH_MAGIC or not machine["little_endian"] or len(keys) != 1:
        raise pickle.UnpicklingError("has a tensor of unknown format")
    count = int.from_bytes(stream.read(8), "little")
    return np.frombuffer(stream.read(), dtype, count)


def _tensor(
    flat: Any, start: int, shape: tuple[int, ...], steps: tuple[int, ...], *_: Any
) -> np.ndarray:
    """PyTorch's tensor, a view of its storage; NumPy refuses one that reaches beyond it."""
    offset_bytes = start * flat.itemsize
    steps_bytes = [step * flat.itemsize for step in steps]
    return np.ndarray(shape, flat.dtype, flat, offset_bytes, steps_bytes)


def _allowed_names() -> dict[str, Any]:
    """Returns the stand-in of each name that a pickle may contain."""
    allowed: dict[str, Any] = {
        "numpy.ndarray": _Part,
        "numpy.dtype": _Dtype,
        "_codecs.encode": _encode,
        "collections.OrderedDict": dict,
        "chumpy.ch.Ch": _Variable,
        "chumpy.reordering.Select": _Selection,
        "torch._utils._rebuild_tensor_v2": _tensor,
        "torch.storage._load_from_bytes": _storage,
        "torch.DoubleStorage": "<f8",
        "torch.FloatStorage": "<f4",
        "torch.HalfStorage": "<f2",
        "torch.LongStorage": "<i8",
        "torch.IntStorage": "<i4",
        "torch.ShortStorage": "<i2",
        "torch.ByteStorage": "<u1",
        "torch.BoolStorage": "?",
    }
    for core in ("core", "_core"):  # NumPy 1 and 2
        allowed[f"numpy.{core}.multiarray._reconstruct"] = _Array
        allowed[f"numpy.{core}.multiarray.scalar"] = _scalar
        allowed[f"numpy.{core}.numeric._frombuffer"] = _numbers
    for form, stand_in in _SPARSE.items():
        for module in (f"scipy.sparse.{form}", f"scipy.sparse._{form}"):
            allowed[f"{module}.{form}_matrix"] = stand_in
            allowed[f"{module}.{form}_array"] = stand_in
    for module in ("copy_reg", "copyreg"):  # Python 2 and 3
        allowed[f"{module}._reconstructor"] = _rebuilt
    for module in ("__builtin__", "builtins"):
        allowed[f"{module}.set"] = set
        allowed[f"{module}.object"] = object
    return allowed


_ALLOWED = _allowed_names()
_PLAIN = (bool, int, float, str, bytes, np.generic)


class _Unpickler(pickle.Unpickler):
    """Unpickles what arrays need; strings of Python 2 are read as Latin-1."""

    def __init__(self, stream: BinaryIO) -> None:
        super().__init__(stream, encoding="latin-1")

    def find_class(self, module: str, name: str) -> Any:
        """The stand-in of a name; an UnpicklingError for any other name."""
        full = f"{module}.{name}"
        if full not in _ALLOWED:
            raise pickle.UnpicklingError(f"names {full[:80]!r}, which is not part of an array")
        return _ALLOWED[full]


class _StorageUnpickler(_Unpickler):
    """Unpickles a PyTorch storage, which refers to its dtype from outside."""

    def persistent_load(self, reference: Any) -> Any:
        """Dtype of a PyTorch storage: ("storage", dtype, key, place, count, view)."""
        return reference[1]


def _resolved(part: Any) -> Any:
    """Array or plain value that a stand-in represents; None for an unknown class."""
    match part:
        case _Array():
            return _array(part)
        case _Sparse():
            return _dense(part)
        case _Variable():
            return _resolved(part.state["x"])
        case _Selection():
            variable = _resolved(part.state["a"])
            index = _resolved(part.state["idxs"])
            return variable.ravel()[index].reshape(part.state["preferred_shape"])
        case _Part():
            return None
    return part


def _array(part: _Array) -> Any:
    """Array of numbers; of an array of objects its element, or the list of its elements."""
    _, shape, kind, is_fortran, data = part.state
    if kind.arguments[0] in ("O8", "O"):
        return _resolved(data[0]) if shape == () else data
    return _numbers(data, kind, shape, "F" if is_fortran else "C")


def _dense(part: _Sparse) -> np.ndarray:
    """Dense array of a SciPy matrix; values at the same place are added."""
    state = part.state
    values = _resolved(state["data"])
    if isinstance(part, _SPARSE["coo"]):
        coordinates = state["coords"] if "coords" in state else (state["row"], state["col"])
        places = tuple(map(_resolved, coordinates))
    else:
        minor = _resolved(state["indices"])
        starts = _resolved(state["indptr"])
        major = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
        is_by_rows = isinstance(part, _SPARSE["csr"])
        places = (major, minor) if is_by_rows else (minor, major)
    dense = np.zeros(state["_shape"], values.dtype)
    np.add.at(dense, places, values)
    return dense


def _arrays(name: str, value: Any) -> Iterator[tuple[str, np.ndarray]]:
    """Arrays of a value with their names: see `pickles.read_pickle`."""
    value = _resolved(value)
    if isinstance(value, dict):
        for key, item in value.items():
            if isinstance(key, bytes):
                yield from _arrays(f"{name}/{key.decode('latin-1')}", item)
            elif isinstance(key, str):
                yield from _arrays(f"{name}/{key}", item)
        return
    if value is None:
        yield name, np.empty(0)
    elif isinstance(value, (np.ndarray, list, tuple, *_PLAIN)):
        with contextlib.suppress(ValueError):  # rows of different lengths
            array = np.asarray(_rows(value))
            if array.dtype != object:
                yield name, array


def _rows(value: Any) -> Any:
    """Nested lists of plain values and arrays, resolved; raises a ValueError for others."""
    value = _resolved(value)
    if isinstance(value, (list, tuple)):
        return [_rows(item) for item in value]
    if not isinstance(value, (np.ndarray, *_PLAIN)):
        raise ValueError
    return value


def main(pickles: str, answer: str, memory: str, seconds: str, size: str) -> None:
    """Writes the arrays of all pickles, under names that begin with the pickle's number."""
    limit_this_process(int(memory), float(seconds), int(size))
    arrays: dict[str, np.ndarray] = {}
    try:
        with zipfile.ZipFile(pickles) as archive:
            for member in archive.namelist():
                print(f"\n{member}", end=" ", flush=True)
                arrays |= _arrays(member, _Unpickler(io.BytesIO(archive.read(member))).load())
        np.savez(answer, allow_pickle=False, **arrays)  # type: ignore[arg-type]
    except Exception as error:  # whatever a damaged file makes of an unpickler
        sys.exit(print(_reason(error)) or 1)


def _reason(error: Exception) -> str:
    """Reason of a refusal: a predicate without a full stop."""
    if isinstance(error, pickle.UnpicklingError) and str(error).startswith(("has ", "names ")):
        return ascii(str(error))[1:-1]
    match error:
        case MemoryError():
            return "needs too much memory"
        case RecursionError():
            return "contains itself, or is nested too deeply"
        case OSError():
            return "has arrays that are too large"
    return "is not a pickle, or is damaged"


if __name__ == "__main__":
    main(*sys.argv[1:])
