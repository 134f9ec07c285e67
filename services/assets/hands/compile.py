"""Compiles robot descriptions, URDF or MJCF, with MuJoCo, within limits.

Files of strangers are compiled in a confined process (`reading.confined`).
"""

import contextlib
import os
import pathlib
import re
from collections import Counter
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.assets.hands.reading import (
    FaultyFile,
    listed,
    missing_files,
    reading_error,
)
from congrasp.services.assets.hands.robot_texts import Texts, read_texts
from congrasp.services.assets.hands.urdf import check_no_xacro, urdf_spec
from congrasp.services.assets.hands.urdf_inertias import LEAST_INERTIA, LEAST_MASS

MAX_COUNT = 1000
"""Largest count of a replicate, composite or flexcomp in the file; nested ones are bounded by the
limits of the confined process.
"""
LIMITS = {
    "nbody": 1000,
    "nv": 500,
    "ngeom": 10_000,
    "nmesh": 1000,
    "nmeshvert": 5_000_000,
    "nu": 1000,
    "neq": 1000,
}
"""Limits of a model's parts, by MuJoCo's names."""
_FINITE = (
    "body_pos",
    "body_quat",
    "body_mass",
    "body_inertia",
    "jnt_pos",
    "jnt_axis",
    "jnt_range",
    "geom_pos",
    "geom_size",
    "geom_quat",
    "mesh_vert",
    "dof_armature",
    "dof_damping",
    "actuator_biasprm",
    "actuator_forcerange",
)
"""Arrays of a model that must be finite."""
_NONNEGATIVE = ("body_mass", "body_inertia")
_RESERVES = ("njmax", "nconmax", "nstack")
"""Memory that a file reserves."""
_ROOT = re.compile(r"<\s*([A-Za-z_][\w:.-]*)")
_COUNT = re.compile(r"""\bcount\s*=\s*["']([^"']*)["']""")
_CLASS = re.compile(r"""<default\b[^<>]*?\bclass\s*=\s*["']([^"']+)["']""")
_OPENED_FILE = re.compile(r"opening file '(.*)'")
_MESH_REASONS = {
    "coplanar|too small": "flat",
    "decoder": "not readable",
    "orient": "inside out",
    "": "rejected by MuJoCo",
}
"""Reasons why a mesh is left out, by patterns in MuJoCo's error; the first match wins."""


class _Rejected(NamedTuple):
    """An asset that MuJoCo rejected."""

    asset: Any
    reason: str
    name: str


def robot_spec(path: pathlib.Path, notes: list[str]) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """Reads a URDF or MJCF file, whose root element determines which it is.

    Args:
      path: the file. A stranger's belongs into a function of `reading.confined`.
      notes: omissions are appended.

    Returns:
      The modifiable model, without reserves of memory, and the compiled one.

    Raises:
      CongraspError: it cannot be read, or has more parts than `LIMITS`.
    """
    try:
        with contextlib.chdir(path.parent):  # an attached model's files are searched from there
            spec = _spec(pathlib.Path.cwd() / path.name, notes)
            model = _compiled(spec, notes)
        _check_model(model)
    except (ValueError, OSError, MemoryError, RuntimeError, mujoco.FatalError) as error:
        raise reading_error(path, error) from None
    return spec, model


def _check_model(model: mujoco.MjModel) -> None:
    """Raises a ValueError for a model of too many parts, or of invalid numbers."""
    for name, limit in LIMITS.items():
        count = getattr(model, name)
        if count > limit:
            raise ValueError(f"it has {count} parts of the kind {name}, more than {limit}")
    for name in _FINITE:
        if not np.isfinite(getattr(model, name)).all():
            raise ValueError(f"its {name} holds numbers that are not finite")
    for name in _NONNEGATIVE:
        if (getattr(model, name) < 0).any():
            raise ValueError(f"its {name} holds numbers below zero")


def _spec(path: pathlib.Path, notes: list[str]) -> mujoco.MjSpec:
    """The model of a file, not compiled.

    Raises:
      ValueError: it is not a robot description that can be read.
      OSError: a file cannot be read.
    """
    texts = read_texts(path)
    _check_counts(texts)
    root = _ROOT.search(texts.main)
    kind = root[1] if root else ""
    if kind == "robot":
        check_no_xacro(path, texts.main)
        spec = urdf_spec(path, texts.main, notes)
    elif kind == "mujoco":
        spec = _mjcf_spec(path, texts)
    elif kind == "mujocoinclude":
        raise FaultyFile("it is a part of an MJCF. Import the file that includes it")
    else:
        fault = f"its root element is '{kind[:40]}'" if kind else "it is no XML"
        raise FaultyFile(
            f"{fault}, not robot (URDF) or mujoco (MJCF). Export the robot as one of these"
        )
    spec.compiler.fusestatic = False
    _remove_unused(spec)
    for body in spec.bodies:
        if body.explicitinertial and body.mass < 0:
            raise ValueError(f"the body '{body.name[:60]}' has the mass {body.mass:g} kg")
    for asset in (*spec.meshes, *spec.textures, *spec.hfields, *spec.skins):
        if "\\" in asset.file:
            asset.file = asset.file.replace("\\", "/")
    return spec


def _check_counts(texts: Texts) -> None:
    """Raises a ValueError for parts that are repeated too often."""
    for count in _COUNT.findall("\n".join(texts.all())):
        if any(float(number) > MAX_COUNT for number in count.split()):
            raise ValueError(f"it repeats a part {count[:40]} times, more than {MAX_COUNT}")


def _mjcf_spec(path: pathlib.Path, texts: Texts) -> mujoco.MjSpec:
    """The model of an MJCF file.

    Raises:
      ValueError: it cannot be read.
    """
    included = {name: text.encode() for name, text in texts.included.items()}
    try:
        spec = mujoco.MjSpec.from_string(texts.main, include=included)
    except ValueError as error:
        raise ValueError(f"{error} {_repeated_classes(texts, str(error))}") from None
    spec.modelfiledir = str(path.parent)
    return spec


def _repeated_classes(texts: Texts, error: str) -> str:
    """Names of default classes that occur more than once, if the error is about them."""
    if "repeated default class" not in error:
        return ""
    counts: Counter[str] = Counter()
    for text in texts.all():
        counts.update(_CLASS.findall(text))
    repeated = [f"'{name}'" for name, count in counts.items() if count > 1]
    return f"repeated: {', '.join(repeated)}"


def _remove_unused(spec: mujoco.MjSpec) -> None:
    """Removes the memory that a file reserves, which may be more than there is, and its sensors."""
    spec.memory = -1
    spec.nuserdata = 0
    spec.nkey = 0
    user_data = [name for name in dir(spec) if name.startswith("nuser_")]
    for name in (*_RESERVES, *user_data):
        setattr(spec, name, -1)
    for group in (spec.sensors, spec.cameras, spec.lights, spec.numerics, spec.texts, spec.tuples):
        for element in list(group):
            spec.delete(element)


def _compiled(spec: mujoco.MjSpec, notes: list[str]) -> mujoco.MjModel:
    """The compiled model, without missing files and unusable meshes.

    Raises:
      ValueError: it cannot be compiled.
    """
    for i, mesh in enumerate(spec.meshes):
        # MuJoCo's errors end with it, and do not name the kind of their element
        mesh.info = f"{mesh.info} (mesh {i})"
    bounded = False
    first_rejection: ValueError | None = None
    left_out: dict[str, list[str]] = {}  # names by the reason
    while True:  # until there is nothing more to leave out
        try:
            model = spec.compile()
            break
        except ValueError as error:
            rejected = _rejected(spec, str(error))
            if "mass and inertia" in str(error) and not bounded:
                spec.compiler.boundmass = LEAST_MASS
                spec.compiler.boundinertia = LEAST_INERTIA
                bounded = True
            elif rejected is not None:
                first_rejection = first_rejection or error
                left_out.setdefault(rejected.reason, []).append(rejected.name)
                _leave_out(spec, rejected.asset)
            elif first_rejection is not None and "geom '" in str(error):
                # A pair or a tendon may name a geom that was left out
                raise first_rejection from None
            else:
                raise error from None
    notes += [missing_files(reason, names) for reason, names in left_out.items()]
    if bounded:
        notes += _bounded_links(model)
    return model


def _bounded_links(model: mujoco.MjModel) -> list[str]:
    """Notes on links that have the least mass or inertia."""
    has_least_mass = model.body_mass == LEAST_MASS
    has_least_inertia = (model.body_inertia == LEAST_INERTIA).any(1)
    notes = []
    for links, text in (
        (has_least_mass, f"mass get {1e3 * LEAST_MASS:g} g"),
        (has_least_inertia & ~has_least_mass, f"inertia get {1e6 * LEAST_INERTIA:g} kg.mm²"),
    ):
        names = [model.body(body).name for body in np.flatnonzero(links)]
        what = f"links without {text} ('<inertial>' in the file), as do those with less"
        notes += listed(what, names)
    return notes


def _rejected(spec: mujoco.MjSpec, error: str) -> _Rejected | None:
    """The asset that MuJoCo's error is about; None if there is no such asset."""
    opened = _OPENED_FILE.search(error)
    if opened:
        missing = _missing_asset(spec, opened[1])
        if missing is not None:
            return missing
    for mesh in spec.meshes:
        if error.endswith(mesh.info):
            return _Rejected(mesh, _mesh_reason(error), mesh.name)
    return None


def _missing_asset(spec: mujoco.MjSpec, opened: str) -> _Rejected | None:
    """The asset whose file MuJoCo could not open; None if there is none.

    MuJoCo's path may be relative to another folder, so the closest of the files of that name is
    taken.
    """
    file_name = pathlib.PurePath(opened).name
    best = None
    best_closeness = (False, False, -1)
    for asset, name, path in _asset_files(spec):
        if pathlib.PurePath(name).name != file_name:
            continue
        closeness = (path == opened, opened.endswith(name), len(name))
        if closeness > best_closeness:
            best = _Rejected(asset, "not found", name)
            best_closeness = closeness
    return best


def _asset_files(spec: mujoco.MjSpec) -> Iterator[tuple[Any, str, str]]:
    """Yields each asset of a file, the name of the file in the description, and its path."""
    folders = (
        (spec.meshdir, (*spec.meshes, *spec.hfields, *spec.skins)),
        (spec.texturedir, spec.textures),
    )
    for folder, assets in folders:
        for asset in assets:
            names = filter(None, (asset.file, *getattr(asset, "cubefiles", ())))
            for name in names:
                yield asset, name, os.path.normpath(os.path.join(folder, name))


def _mesh_reason(error: str) -> str:
    """Reason for which MuJoCo rejected a mesh."""
    first_line = error.partition("\n")[0]
    return next(
        reason for pattern, reason in _MESH_REASONS.items() if re.search(pattern, first_line)
    )


def _leave_out(spec: mujoco.MjSpec, asset: Any) -> None:
    """Removes an asset, its geoms, and its place in materials."""
    field = {mujoco.MjsMesh: "meshname", mujoco.MjsHField: "hfieldname"}.get(type(asset), "")
    if field and asset.name:
        for geom in [geom for geom in spec.geoms if getattr(geom, field) == asset.name]:
            spec.delete(geom)
    if isinstance(asset, mujoco.MjsTexture):
        for material in spec.materials:
            material.textures = ["" if name == asset.name else name for name in material.textures]
    spec.delete(asset)
