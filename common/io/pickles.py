"""Arrays out of a pickle without unpickling it: opcodes are read as data, and nothing that they name is ever called.

Python's own `pickle.load` runs whatever a file tells it to run. Here a global is only its name, an object only a name
with arguments and state, and the few names that stand for arrays are turned into arrays by this module. Any other name
refuses the file.
"""

import codecs
import io
import math
import pathlib
import pickletools
import re
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_file

_REMEDY = "Only pickles of plain values and arrays are read; get the file again."
MAX_BYTES = 256 << 20
"""Bytes that a pickle may have."""
MAX_STEPS = 1_000_000
"""Opcodes that a pickle may have, those of the tensors inside of it included."""
MAX_DEPTH = 100
"""Containers and objects inside of one another."""
MAX_WRITTEN_OUT = 1 << 30
"""Bytes of all values with what is shared counted as often as it is used, at `_VALUE` each beside an array's own."""
MAX_COPIED = 512 << 20
"""Bytes of all arrays and texts that are made of the file's."""
_VALUE = 512
_NUMBER = re.compile(r"[<>=|]?(\?|[biuf]\d{1,2})")
_ARRAY = ("numpy.core.multiarray._reconstruct", "numpy._core.multiarray._reconstruct")
_BUFFER = ("numpy.core.numeric._frombuffer", "numpy._core.numeric._frombuffer")
_SCALAR = ("numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar")
_DTYPE, _OBJECT = "numpy.dtype", ("copy_reg._reconstructor", "copyreg._reconstructor")
_SPARSE = ("scipy.sparse.csc.csc_matrix", "scipy.sparse._csc.csc_matrix")
_VARIABLE, _SELECTION = "chumpy.ch.Ch", "chumpy.reordering.Select"
_ENCODE = "_codecs.encode"
_SETS = ("__builtin__.set", "builtins.set")
_TENSOR, _STORAGE_BYTES = "torch._utils._rebuild_tensor_v2", "torch.storage._load_from_bytes"
_STORAGES = {
    "torch.DoubleStorage": "<f8",
    "torch.FloatStorage": "<f4",
    "torch.HalfStorage": "<f2",
    "torch.LongStorage": "<i8",
    "torch.IntStorage": "<i4",
    "torch.ShortStorage": "<i2",
    "torch.ByteStorage": "<u1",
    "torch.BoolStorage": "?",
}
_TORCH_MAGIC = 0x1950A86A20F9469CFC6C
_PASSIVE = ("numpy.ndarray", "__builtin__.object", "builtins.object")
KNOWN = {*_ARRAY, *_BUFFER, *_SCALAR, _DTYPE, *_OBJECT, *_SPARSE, _VARIABLE, _SELECTION, _ENCODE, *_SETS, *_PASSIVE}
"""Names that a file may use."""
TORCH = {_TENSOR, _STORAGE_BYTES, *_STORAGES, "collections.OrderedDict"}
"""Names that a file with PyTorch's tensors may use besides."""
_OPCODES: dict[str, Any] = {opcode.code: opcode for opcode in pickletools.opcodes}
_ENDED, _MARK = object(), object()


class _Name(NamedTuple):
    """A global: its module and name."""

    text: str


class _Made:
    """What a file says is made of a name: the arguments, and a state that came later."""

    def __init__(self, name: str, arguments: tuple[Any, ...]):
        self.name = name
        self.arguments = arguments
        self.state: Any = None


class _Refused(Exception):
    """Why a file is not read, in words."""


def read_pickle(path: pathlib.Path, *, mixed: bool = False) -> Any:
    """The file's value: plain Python values and NumPy arrays, which sparse matrices and chumpy's variables become, too.

    Strings of Python 2 are read as Latin-1.

    Args:
      path: the file.
      mixed: arrays may also hold values of any kind, and PyTorch's tensors are read as arrays.

    Raises:
      CongraspError: there is no such file, or it is no pickle of arrays; the line says which name or opcode it is.
    """
    try:
        return parse_pickle(read_file(path, MAX_BYTES, _REMEDY), str(path), mixed=mixed)
    except OSError as error:
        raise CongraspError(f"{path} cannot be read: {error.strerror}.") from None


def parse_pickle(data: bytes, name: str, *, mixed: bool = False) -> Any:
    """The value of a pickle in memory; see `read_pickle`.

    Args:
      data: the pickle.
      name: where it comes from, for error messages.
      mixed: see there.
    """
    budget = _Budget()
    try:
        return _Plain(mixed, budget)(_run(io.BytesIO(data), KNOWN | TORCH if mixed else KNOWN, budget))
    except _Refused as error:
        what = str(error)
    except RecursionError:
        what = "is nested too deeply"
    except (ValueError, TypeError, LookupError, AttributeError, MemoryError, OverflowError):
        what = "is damaged"
    raise CongraspError(f"{name} {what}.", _REMEDY)


class _Budget:
    """What a file may still cost, before it is spent."""

    def __init__(self) -> None:
        self._steps, self._copied = MAX_STEPS, MAX_COPIED

    def step(self) -> None:
        """One opcode more."""
        self._steps -= 1
        if self._steps < 0:
            raise _Refused(f"has more than {MAX_STEPS} opcodes")

    def copy(self, size: int) -> None:
        """An array or a text of this many bytes is about to be made."""
        self._copied -= size
        if size < 0 or self._copied < 0:
            raise _Refused(f"makes more than {MAX_COPIED >> 20} MB of arrays")


def _run(stream: io.BytesIO, known: set[str], budget: _Budget) -> Any:
    """What the opcodes leave on the stack at their end; globals must have known names."""
    stack: list[Any] = []
    memo: dict[int, Any] = {}
    while True:
        budget.step()
        code = stream.read(1)
        opcode = _OPCODES.get(code.decode("latin-1"))
        if opcode is None:
            raise _Refused("is no pickle, or is cut off" if code == b"" else "is no pickle")
        if opcode.name == "STRING":  # pickletools decodes it as ASCII, which an array's bytes are not
            quoted = pickletools.read_stringnl(stream, decode=False, stripquotes=True)
            text: Any = codecs.escape_decode(quoted)[0]
            argument: Any = text.decode("latin-1")
        else:
            argument = opcode.arg.reader(stream) if opcode.arg else None
        if opcode.name == "STOP":
            return stack.pop()
        _step(opcode.name, argument, stack, memo, known)


_CONSTANTS: dict[str, Any] = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_LITERALS = {
    *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"),
    *("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8"),
    *("BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"),
}


def _step(name: str, argument: Any, stack: list[Any], memo: dict[int, Any], known: set[str]) -> None:
    """Carries out one opcode."""
    match name:
        case "PROTO" | "FRAME":
            pass
        case "MARK":
            stack.append(_MARK)
        case "NONE" | "NEWTRUE" | "NEWFALSE":
            stack.append(_CONSTANTS[name])
        case "EMPTY_DICT":
            stack.append({})
        case "EMPTY_LIST":
            stack.append([])
        case "EMPTY_TUPLE":
            stack.append(())
        case "EMPTY_SET":
            stack.append(set())
        case "DICT":
            items = _since_mark(stack)
            stack.append(dict(zip(_keys(items[::2]), items[1::2], strict=True)))
        case "LIST":
            stack.append(_since_mark(stack))
        case "TUPLE":
            stack.append(tuple(_since_mark(stack)))
        case "TUPLE1" | "TUPLE2" | "TUPLE3":
            count = int(name[-1])
            stack[-count:] = [tuple(stack[-count:])]
        case "APPEND" | "APPENDS":
            items = _since_mark(stack) if name == "APPENDS" else [stack.pop()]
            _of(list, stack).extend(items)
        case "SETITEM" | "SETITEMS":
            items = _since_mark(stack) if name == "SETITEMS" else [stack.pop(-2), stack.pop()]
            _of(dict, stack).update(zip(_keys(items[::2]), items[1::2], strict=True))
        case "ADDITEMS":
            items = _since_mark(stack)
            _of(set, stack).update(_keys(items))
        case "PUT" | "BINPUT" | "LONG_BINPUT":
            memo[argument] = stack[-1]
        case "MEMOIZE":
            memo[len(memo)] = stack[-1]
        case "GET" | "BINGET" | "LONG_BINGET":
            stack.append(memo[argument])
        case "POP":
            stack.pop()
        case "POP_MARK":
            _since_mark(stack)
        case "GLOBAL":
            stack.append(_known(argument.replace(" ", "."), known))
        case "STACK_GLOBAL":
            module, attribute = stack.pop(-2), stack.pop()
            stack.append(_known(f"{module}.{attribute}", known))
        case "REDUCE" | "NEWOBJ":
            made_of, arguments = stack.pop(-2), stack.pop()
            if not (isinstance(made_of, _Name) and isinstance(arguments, tuple)):
                raise _Refused("makes an object of something that is no name")
            stack.append(_Made(made_of.text, arguments))
        case "BINPERSID" if known >= TORCH:
            stack.append(_Made("", stack.pop()))
        case "BUILD":
            state = stack.pop()
            _of(_Made, stack).state = state
        case _ if name in _LITERALS:
            stack.append(argument)
        case _:
            raise _Refused(f"uses the opcode {name}, which pickles of arrays do not need")


def _since_mark(stack: list[Any]) -> list[Any]:
    """Takes what lies above the last mark, and the mark, off the stack."""
    for i in range(len(stack) - 1, -1, -1):
        if stack[i] is _MARK:
            items = stack[i + 1 :]
            del stack[i:]
            return items
    raise _Refused("is damaged")


def _keys(items: Iterable[Any]) -> list[Any]:
    """Keys of a dictionary or members of a set: texts and numbers, whose hashes take no time whatever they hold."""
    keys = list(items)
    if not all(item is None or isinstance(item, (str, bytes, int, float)) for item in keys):
        raise _Refused("has keys that are neither texts nor numbers")
    return keys


def _of(kind: type, stack: list[Any]) -> Any:
    """The top of the stack, which must be of this type."""
    if not isinstance(stack[-1], kind):
        raise _Refused("is damaged")
    return stack[-1]


def _known(name: str, known: set[str]) -> _Name:
    """A name that stands for an array or a part of one."""
    if name not in known:
        raise _Refused(f"names {name[:80]!r}, which stands for no array")
    return _Name(name)


class _Plain:
    """From what was read to plain values and arrays; what the file shares is turned once."""

    def __init__(self, mixed: bool, budget: _Budget) -> None:
        self._mixed, self._budget = mixed, budget
        self._done: dict[int, tuple[Any, int]] = {}
        self._depth = self._size = 0

    def __call__(self, value: Any) -> Any:
        """The plain value; `_size` grows by its bytes, written out."""
        if not isinstance(value, (list, tuple, dict, _Made)):
            self._grow(_VALUE + (len(value) if isinstance(value, (str, bytes, bytearray, set)) else 0))
            return None if isinstance(value, _Name) else value
        key = id(value)
        if key not in self._done:
            self._done[key] = _ENDED, 0
            before, self._depth = self._size, self._depth + 1
            if self._depth > MAX_DEPTH:
                raise _Refused("is nested too deeply")
            turned = self._turned(value)
            self._grow(_VALUE + (turned.nbytes if isinstance(turned, np.ndarray) else 0))
            self._done[key] = turned, self._size - before
            self._depth -= 1
            return turned
        turned, size = self._done[key]
        if turned is _ENDED:
            raise _Refused("contains itself")
        self._grow(size)
        return turned

    def _grow(self, size: int) -> None:
        self._size += size
        if self._size > MAX_WRITTEN_OUT:
            raise _Refused("repeats its values until they fill the memory")

    def _bytes(self, data: Any) -> bytes:
        """The bytes that a text or a buffer holds."""
        self._budget.copy(len(data))
        return data.encode("latin-1") if isinstance(data, str) else bytes(data)

    def _numbers(self, data: Any, kind: Any, count: int = -1) -> np.ndarray:
        """An array (n,) of a buffer's numbers."""
        dtype, content = _dtype(kind), self._bytes(self(data))
        self._budget.copy(len(content))
        return np.frombuffer(content, dtype, count=count).copy()

    def _turned(self, value: Any) -> Any:
        """One value, for the first time."""
        if isinstance(value, (list, tuple)):
            return type(value)(self(item) for item in value)
        if isinstance(value, dict):
            return {self(name): self(item) for name, item in value.items()}
        name, arguments, state = value.name, value.arguments, value.state
        if name in _OBJECT:
            name = arguments[0].text
        if name in _ARRAY:
            _, shape, kind, fortran, data = state
            if self._mixed and isinstance(kind, _Made) and kind.arguments[0] in ("O8", "O"):
                items = self(data)
                array = np.empty(len(items), object)
                for i, item in enumerate(items):
                    array[i] = item
                return array.reshape(tuple(shape), order="F" if fortran else "C")
            return self._numbers(data, kind).reshape(tuple(shape), order="F" if fortran else "C")
        if name in _BUFFER:
            data, kind, shape, order = arguments
            return self._numbers(data, kind).reshape(tuple(shape), order=order)
        if name in _SCALAR:
            return self._numbers(arguments[1], arguments[0], 1)[0]
        if name in _SPARSE:
            return _dense(self(state), self._budget)
        if name == _VARIABLE:
            return self(state["x"])
        if name == _SELECTION:
            whole, index = self(state["a"]), self(state["idxs"])
            self._budget.copy(whole.nbytes + index.size * whole.itemsize)
            return whole.ravel()[index].reshape(self(state["preferred_shape"]))
        if name == _ENCODE:
            text, encoding = arguments
            if encoding != "latin1":
                raise _Refused(f"encodes bytes as {encoding!r:.40}")
            return self._bytes(text)
        if name in _SETS:
            return set(_keys(self(arguments[0])))
        if name == _STORAGE_BYTES:
            return _storage(self._bytes(self(arguments[0])), self._budget)
        if name == _TENSOR:
            flat, start, shape, strides = (self(argument) for argument in arguments[:4])
            last = start + sum((n - 1) * step for n, step in zip(shape, strides, strict=True))
            if start < 0 or min((*shape, *strides), default=1) < 0 or (0 not in shape and last >= len(flat)):
                raise _Refused("has a tensor that is larger than its data")
            size = flat.itemsize
            self._budget.copy(math.prod(shape) * size)
            return np.lib.stride_tricks.as_strided(flat[start:], shape, [size * step for step in strides]).copy()
        return None


def _dtype(made: Any) -> np.dtype[Any]:
    """A number's type: booleans, integers and floats alone."""
    if not (isinstance(made, _Made) and made.name == _DTYPE):
        raise _Refused("has an array of an unknown type")
    kind = str(made.arguments[0])
    if not _NUMBER.fullmatch(kind):
        raise _Refused(f"has an array of {kind[:20]!r}, not of numbers")
    return np.dtype(kind).newbyteorder(">" if made.state and made.state[1] == ">" else "<")


def _storage(data: bytes, budget: _Budget) -> np.ndarray:
    """The numbers of a PyTorch storage in the format of before version 1.6, which pickled tensors still use.

    Five pickles follow one another (a magic number, a version, facts about the machine, a reference to the storage and
    the keys of all storages), then the number of elements as an integer of eight bytes, and the elements.
    """
    stream = io.BytesIO(data)
    magic, _, machine, reference, keys = (_run(stream, TORCH, budget) for _ in range(5))
    if magic != _TORCH_MAGIC or not machine["little_endian"] or len(keys) != 1:
        raise _Refused("has a tensor of an unknown format")
    kind = np.dtype(_STORAGES[reference.arguments[1].text])
    count = int.from_bytes(stream.read(8), "little")
    budget.copy(2 * len(data))
    return np.frombuffer(stream.read(), kind, count=count).copy()


def _dense(state: dict[str, Any], budget: _Budget) -> np.ndarray:
    """A matrix of compressed columns as an array."""
    rows, columns = state["_shape"]
    data, indices, starts = state["data"], state["indices"], np.asarray(state["indptr"], np.int64)
    fits = 0 < rows * columns <= 1e7 and len(starts) == columns + 1 and len(data) == len(indices) == starts[-1]
    if not fits or starts[0] != 0 or (np.diff(starts) < 0).any():
        raise _Refused("has a sparse matrix that is damaged or very large")
    budget.copy(rows * columns * data.itemsize)
    dense = np.zeros((rows, columns), data.dtype)
    dense[indices, np.repeat(np.arange(columns), np.diff(starts))] = data
    return dense
