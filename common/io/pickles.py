"""Reads arrays from pickles, unpickled with an allow-list by a child process under limits.

The child (`common/io/unpickle.py`) knows the names that arrays of NumPy, SciPy, chumpy and PyTorch
need, and refuses all others. It has limited memory, processor time and output, and returns an NPZ
file.
"""

import pathlib
import sys
import tempfile
import zipfile
from collections.abc import Iterable

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.arrays import read_npz
from congrasp.common.io.inputs import read_file
from congrasp.common.runtime.confinement import Limits, run_confined
from congrasp.common.runtime.process_variables import child_environment

MAX_BYTES = 512 << 20
"""Limit in bytes of the pickles read by one process, and of their arrays."""
MAX_ARRAYS = 100_000
"""Limit of the number of arrays."""
MAX_MEMORY_BYTES = 3 << 30
"""Limit of the process's address space."""
MAX_PROCESSOR_S = 10
"""Limit of the process's processor time."""
_TIMEOUT_S = 200.0
"""Limit of the process's duration, for a busy machine."""
_CHILD = pathlib.Path(__file__).with_name("unpickle.py")
_REMEDY = "Only pickles of plain values and arrays are read; download the file again."
_CONVERSION_REMEDY = (
    "If you trust the file, convert it where its packages are installed, and name the NPZ file: "
    "python -c \"import numpy, pickle; d = pickle.load(open('{}', 'rb'), encoding='latin1'); "
    "numpy.savez('{}', **{{k: v.toarray() if hasattr(v, 'toarray') else numpy.array(v) for k, v in "
    'd.items()}})"'
)


def read_pickle(path: pathlib.Path) -> dict[str, np.ndarray]:
    """Arrays of a pickle by name.

    Names of nested dictionaries are joined by "/"; a value outside any dictionary has the name "".
    Numbers, texts and lists of them are arrays, too, and None is an empty array. Other values are
    left out.

    Args:
      path: the file.

    Raises:
      CongraspError: the file is missing, is not a pickle of arrays, or exceeds the limits above.
    """
    return read_pickles([(str(path), read_file(path, MAX_BYTES, _REMEDY))])[0]


def read_pickles(pickles: Iterable[tuple[str, bytes]]) -> list[dict[str, np.ndarray]]:
    """Arrays of each pickle, read in one process; see `read_pickle`.

    Args:
      pickles: (name for error messages, bytes) pairs.

    Raises:
      CongraspError: a pickle is not one of arrays, or together they exceed the limits above.
    """
    with tempfile.TemporaryDirectory(prefix="congrasp-") as folder:
        source = pathlib.Path(folder, "pickles.zip")
        answer = pathlib.Path(folder, "arrays.npz")
        names = _write_pickles(source, pickles)
        if not names:
            return []
        _unpickle(source, answer, names)
        arrays = read_npz(answer, _REMEDY, most=MAX_ARRAYS)
    arrays_by_pickle: list[dict[str, np.ndarray]] = [{} for _ in names]
    for name, array in arrays.items():
        number, _, key = name.partition("/")
        arrays_by_pickle[int(number)][key] = array
    return arrays_by_pickle


def read_archive(path: pathlib.Path) -> dict[str, np.ndarray]:
    """Arrays of an NPZ file by name; those of pickles inside are named as in `read_pickle`.

    Raises:
      CongraspError: it is not an NPZ file, exceeds the limits of `common.io.arrays`, or holds
        anything but plain values and arrays.
    """
    arrays = read_npz(path, "Download the file again.", pickled=True)
    pickles = {
        name: arrays.pop(name) for name, value in list(arrays.items()) if isinstance(value, bytes)
    }
    unpickled = read_pickles((f"{path}, '{name[:60]}'", data) for name, data in pickles.items())
    for name, inner_arrays in zip(pickles, unpickled, strict=True):
        for key, array in inner_arrays.items():
            arrays[f"{name}/{key}".removesuffix("/")] = array
    return arrays


def _write_pickles(source: pathlib.Path, pickles: Iterable[tuple[str, bytes]]) -> list[str]:
    """Writes the child's input: a ZIP archive of the pickles, by number.

    Returns:
      The names of the pickles.

    Raises:
      CongraspError: together they exceed `MAX_BYTES`.
    """
    names: list[str] = []
    total_bytes = 0
    with zipfile.ZipFile(source, "w") as archive:
        for name, data in pickles:
            archive.writestr(str(len(names)), data)
            names.append(name)
            total_bytes += len(data)
            if total_bytes > MAX_BYTES:
                raise CongraspError(
                    f"{name} and the related files exceed {MAX_BYTES >> 20} MB.", _REMEDY
                )
    return names


def _unpickle(source: pathlib.Path, answer: pathlib.Path, names: list[str]) -> None:
    """Runs the child process; a CongraspError names the pickle at which it ended."""
    words = (_CHILD, source, answer, MAX_MEMORY_BYTES, MAX_PROCESSOR_S, MAX_BYTES)
    limits = Limits(
        memory=MAX_MEMORY_BYTES,
        processor_s=MAX_PROCESSOR_S,
        patience_s=_TIMEOUT_S,
        file=answer,
        file_bytes=MAX_BYTES,
    )
    environment = child_environment(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    try:
        child = run_confined(
            [sys.executable, "-P", *map(str, words)], limits, environment, "stdout"
        )
    except TimeoutError:
        raise CongraspError(
            f"{names[0]} was not read within {_TIMEOUT_S:.0f} s.",
            "Stop other programs and try again.",
        ) from None
    if child.code:
        raise _refusal(child.output.decode(errors="replace"), names)


def _refusal(output: str, names: list[str]) -> CongraspError:
    """Returns the error of a child that failed; the last line of its output is the number of the
    pickle, and a reason unless a limit ended it.
    """
    last_line = output.strip("\n").rpartition("\n")[2]
    number, _, reason = last_line.partition(" ")
    name = names[int(number or 0)]
    if not reason:
        reason = (
            f"needs more than {MAX_PROCESSOR_S} s or {MAX_MEMORY_BYTES >> 30} GB, or is damaged"
        )
    remedy = _REMEDY
    if reason.startswith(("names", "has an array")):
        remedy = _CONVERSION_REMEDY.format(name, pathlib.Path(name).stem + ".npz")
    return CongraspError(f"{name} {reason}.", remedy)
