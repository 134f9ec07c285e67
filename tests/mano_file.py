"""A file of MANO's exact layout with the skeleton of the human hand, since MANO itself may not be
passed on.

It is written opcode by opcode as Python 2 wrote it: NumPy arrays, a SciPy matrix, and chumpy's
variables and selections, none of whose packages are needed to write or to read it.
"""

import pickle
import struct
from typing import Any

import numpy as np

from congrasp.common.hands import get_hand
from congrasp.common.hands.mano import MANO_FINGERS, TIP_VERTICES
from congrasp.common.hands.spec import link_origin


class Global(str):
    """A name that the pickle refers to, such as "chumpy.ch Ch"."""


class Reduced:
    """An object of a name, its arguments and its state."""

    def __init__(self, name: str, arguments: tuple = (), state: Any = None, *, new: bool = False):
        self.name = Global(name)
        self.arguments = arguments
        self.state = state
        self.new = new


def dumps(value: Any) -> bytes:
    """A pickle of protocol 2, with the strings of Python 2."""
    return b"\x80\x02" + _opcodes(value) + b"."


def _opcodes(value: Any) -> bytes:
    if isinstance(value, Global):
        return b"c" + value.replace(" ", "\n").encode() + b"\n"
    if isinstance(value, Reduced):
        code = _opcodes(value.name) + _opcodes(value.arguments) + (b"\x81" if value.new else b"R")
        return code if value.state is None else code + _opcodes(value.state) + b"b"
    if isinstance(value, np.ndarray):
        return _opcodes(_array(value))
    if isinstance(value, str | bytes):
        text = value.encode("latin-1") if isinstance(value, str) else value
        return b"T" + struct.pack("<I", len(text)) + text
    if isinstance(value, dict):
        return b"}(" + b"".join(_opcodes(k) + _opcodes(v) for k, v in value.items()) + b"u"
    if isinstance(value, list | tuple):
        return b"(" + b"".join(map(_opcodes, value)) + (b"l" if isinstance(value, list) else b"t")
    return pickle.dumps(value, 2)[2:-1]  # numbers, booleans and None


def _array(value: np.ndarray) -> Reduced:
    kind = Reduced(
        "numpy dtype", (value.dtype.str[1:], 0, 1), (3, "<", None, None, None, -1, -1, 0)
    )
    fortran = not value.flags.c_contiguous
    return Reduced(
        "numpy.core.multiarray _reconstruct",
        (Global("numpy ndarray"), (0,), "b"),
        (1, value.shape, kind, fortran, value.tobytes("F" if fortran else "C")),
    )


def sparse(matrix: np.ndarray) -> Reduced:
    """A matrix as SciPy's compressed columns."""
    columns = [np.flatnonzero(column) for column in matrix.T]
    state = {
        "_shape": matrix.shape,
        "maxprint": 50,
        "indices": np.concatenate(columns).astype(np.int32),
        "indptr": np.cumsum([0, *map(len, columns)]).astype(np.int32),
        "data": np.concatenate([matrix[rows, i] for i, rows in enumerate(columns)]),
    }
    return Reduced("scipy.sparse.csc csc_matrix", (), state, new=True)


def selection(chosen: np.ndarray, values: np.ndarray) -> Reduced:
    """The first columns of `whole` as chumpy keeps them: a variable, indices into it, and a
    shape.
    """
    index = np.arange(values.size).reshape(values.shape)[..., : chosen.shape[-1]].ravel()
    inside = Reduced(
        "chumpy.ch Ch",
        (),
        {"x": values, "_dirty_vars": Reduced("__builtin__ set", ([],))},
        new=True,
    )
    state = {"a": inside, "idxs": index, "preferred_shape": chosen.shape}
    return Reduced("chumpy.reordering Select", (), state, new=True)


def skeleton() -> tuple[np.ndarray, np.ndarray]:
    """Joints (16, 3) and fingertips (5, 3) of the human hand, in MANO's order and frame, away from
    the origin.
    """
    hand = get_hand("human")
    links = {link.name: link for link in hand.links}
    joints = [np.zeros(3)]
    tips = []
    for finger in MANO_FINGERS:
        names = (
            ("metacarpal", "proximal", "distal")
            if finger == "thumb"
            else ("proximal", "middle", "distal")
        )
        joints += [np.array(link_origin(links[f"{finger}_{name}"])) for name in names]
        tips.append(np.array(links[f"{finger}_distal"].tip))
    offset = np.array([0.095, 0.006, 0.006])
    return np.array(joints)[:, [1, 2, 0]] + offset, np.array(tips)[:, [1, 2, 0]] + offset


def content(seed: int = 0) -> dict[str, Any]:
    """What the file says, by MANO's names; joints and tips are vertices of their own, the rest is
    random.
    """
    rng = np.random.default_rng(seed)
    vertices = rng.normal(0.0, 0.03, (778, 3))
    joints, tips = skeleton()
    free = [i for i in range(778) if i not in TIP_VERTICES.values()][:16]
    vertices[free] = joints
    vertices[[TIP_VERTICES[finger] for finger in MANO_FINGERS]] = tips
    regressor = np.zeros((16, 778))
    regressor[np.arange(16), free] = 1.0
    directions = rng.normal(0.0, 1e-3, (778, 3, 20))
    return {
        "v_template": vertices,
        "shapedirs": directions[..., :10],
        "all_directions": directions,
        "posedirs": np.asfortranarray(rng.normal(0.0, 1e-3, (778, 3, 135))),
        "J_regressor": regressor,
        "J": joints,
        "weights": rng.uniform(0.0, 1.0, (778, 16)),
        "f": rng.integers(0, 778, (1538, 3)).astype(np.uint32),
        "kintree_table": np.array(
            [[2**32 - 1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14], list(range(16))]
        ),
        "hands_components": rng.normal(0.0, 1.0, (45, 45)),
        "hands_mean": rng.normal(0.0, 0.2, 45),
        "hands_coeffs": rng.normal(0.0, 1.0, (20, 45)),
        "bs_style": "lbs",
        "bs_type": "lrotmin",
    }


def mano_pickle(values: dict[str, Any] | None = None) -> bytes:
    """The file's bytes."""
    values = dict(values or content())
    directions = values.pop("all_directions")
    if "shapedirs" in values:
        values["shapedirs"] = selection(values["shapedirs"], directions)
    if "J_regressor" in values:
        values["J_regressor"] = sparse(values["J_regressor"])
    return dumps(values)
