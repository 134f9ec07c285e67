"""Child process of `common.io.pickles`: unpickles with an allow-list, under limits, and answers
with arrays.

    python unpickle.py PICKLES ANSWER MEMORY SECONDS BYTES

PICKLES is a ZIP archive whose members are pickles, ANSWER the NPZ file to write. Each pickle's
number is printed before it is read, followed by the reason if it is refused. Only NumPy is
imported, so that the process starts fast.

Every class that a pickle may name is a stand-in. NumPy's own `dtype.__setstate__` takes its flags
from the file, which turns bytes into pointers.
"""

import contextlib
import io
import pickle
import re
import resource
import sys
import zipfile
from collections.abc import Iterator
from typing import Any, BinaryIO

import numpy as np

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
    return np.dtype(name).newbyteorder(">" if kind.state and kind.state[1] == ">" else "<")


def _encode(text: str, _: str) -> bytes:
    """Bytes that Python 3 wrote as Latin-1 text, for protocols without bytes."""
    return text.encode("latin-1")


def _numbers(data: Any, kind: Any, shape: Any, order: str) -> np.ndarray:
    """Array of a buffer, which Python 2 wrote as text."""
    buffer = data.encode("latin-1") if isinstance(data, str) else data
    return np.frombuffer(buffer, _dtype(kind)).reshape(
        tuple(shape), order="F" if order == "F" else "C"
    )


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
    size = flat.itemsize
    return np.ndarray(shape, flat.dtype, flat, start * size, [step * size for step in steps])


_NUMPY = {"_reconstruct": _Array, "scalar": _scalar}
_ALLOWED: dict[str, Any] = {
    **{
        f"numpy.{core}.multiarray.{name}": made
        for core in ("core", "_core")
        for name, made in _NUMPY.items()
    },
    **{f"numpy.{core}.numeric._frombuffer": _numbers for core in ("core", "_core")},
    **{"numpy.ndarray": _Part, "numpy.dtype": _Dtype, "_codecs.encode": _encode},
    **{
        f"scipy.sparse.{mark}{form}.{form}_{kind}": made
        for form, made in _SPARSE.items()
        for mark in ("", "_")
        for kind in ("matrix", "array")
    },
    **{"chumpy.ch.Ch": _Variable, "chumpy.reordering.Select": _Selection},
    **{f"{module}._reconstructor": _rebuilt for module in ("copy_reg", "copyreg")},
    **{
        f"{module}.{kind.__name__}": kind
        for module in ("__builtin__", "builtins")
        for kind in (set, object)
    },
    **{"torch._utils._rebuild_tensor_v2": _tensor, "torch.storage._load_from_bytes": _storage},
    **{"torch.DoubleStorage": "<f8", "torch.FloatStorage": "<f4", "torch.HalfStorage": "<f2"},
    **{"torch.LongStorage": "<i8", "torch.IntStorage": "<i4", "torch.ShortStorage": "<i2"},
    **{"torch.ByteStorage": "<u1", "torch.BoolStorage": "?", "collections.OrderedDict": dict},
}


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
    """Array, or plain value, that an object stands for; None if it stands for none."""
    match part:
        case _Array():
            _, shape, kind, fortran, data = part.state
            if kind.arguments[0] in ("O8", "O"):
                return _resolved(data[0]) if shape == () else data
            return _numbers(data, kind, shape, "F" if fortran else "C")
        case _Sparse():
            state, values = part.state, _resolved(part.state["data"])
            if isinstance(part, _SPARSE["coo"]):
                places = tuple(
                    map(
                        _resolved,
                        state["coords"] if "coords" in state else (state["row"], state["col"]),
                    )
                )
            else:
                inner, starts = _resolved(state["indices"]), _resolved(state["indptr"])
                places = inner, np.repeat(np.arange(len(starts) - 1), np.diff(starts))
            dense = np.zeros(state["_shape"], values.dtype)
            np.add.at(dense, places[::-1] if isinstance(part, _SPARSE["csr"]) else places, values)
            return dense
        case _Variable():
            return _resolved(part.state["x"])
        case _Selection():
            whole, index = _resolved(part.state["a"]), _resolved(part.state["idxs"])
            return whole.ravel()[index].reshape(part.state["preferred_shape"])
    return None if isinstance(part, _Part) else part


def _arrays(name: str, value: Any) -> Iterator[tuple[str, np.ndarray]]:
    """Arrays of a value with their names: see `pickles.read_pickle`."""
    value = _resolved(value)
    if isinstance(value, dict):
        for key, item in value.items():
            if isinstance(key, str | bytes):
                yield from _arrays(
                    f"{name}/{key if isinstance(key, str) else key.decode('latin-1')}", item
                )
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
    for kind, limit in (
        (resource.RLIMIT_AS, int(memory)),
        (resource.RLIMIT_CPU, int(seconds)),
        (resource.RLIMIT_FSIZE, int(size)),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(kind)[1]
        most = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(kind, (most, most))
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
