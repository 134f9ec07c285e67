"""Compiles robot descriptions with MuJoCo in a child process, since a few lines can exceed a machine's resources.

`python -m congrasp.services.assets.hands.compile FILE RESULT` is that process. It writes the compiled model to RESULT,
and its omissions, or the reason for a failure, to RESULT.json.
"""

import json
import os
import pathlib
import re
import resource
import signal
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import trimesh

import congrasp
from congrasp.common.errors import CongraspError

MEMORY = 3 << 30
"""Limit of the address space for reading a file, bytes."""
SECONDS = 30
"""Limit of the time for reading a file, s."""
MAX_FILE = 64 << 20
"""Limit of a file, bytes."""
MAX_COUNT = 1000
"""Largest count of a replicate, composite or flexcomp in the file; nested ones are bounded by the limits above."""
LIMITS = {"nbody": 1000, "nv": 500, "ngeom": 10_000, "nmesh": 1000, "nmeshvert": 5_000_000, "nu": 1000, "neq": 1000}
"""Limits of a model's parts, by MuJoCo's names."""
LEAST = 1e-3, 1e-7
"""Mass (kg) and inertia (kg m2) of moving links without mass."""
_COUNTS = re.compile(r"""\bcount\s*=\s*["']([^"']*)["']""")
_FINITE = (
    *(
        "body_pos",
        "body_quat",
        "body_mass",
        "body_inertia",
        "jnt_pos",
        "jnt_axis",
        "jnt_range",
        "geom_pos",
        "geom_size",
    ),
    *("geom_quat", "mesh_vert", "dof_armature", "dof_damping", "actuator_biasprm", "actuator_forcerange"),
)
_NATIVE = (".stl", ".obj", ".msh")
_ROOT = pathlib.Path(congrasp.__file__).parents[1]
_REMEDY = "MuJoCo must be able to load it."


def compiled_model(path: pathlib.Path, notes: list[str]) -> mujoco.MjModel:
    """Compiles a URDF or MJCF file, without missing meshes.

    Args:
      path: the file.
      notes: omissions are appended.

    Raises:
      CongraspError: it cannot be read, or not within `MEMORY` and `SECONDS`, or it has more parts than `LIMITS`.
    """
    if path.suffix.lower() not in (".xml", ".urdf", ".mjcf"):
        raise CongraspError(f"{path} is neither URDF nor MJCF.", "Pass a file that ends in .urdf or .xml.")
    if not path.is_file():
        raise CongraspError(f"There is no file {path}.", "Check the path.")
    if path.stat().st_size > MAX_FILE:
        raise CongraspError(f"{path} has more than {MAX_FILE >> 20} MB.", "Pass a robot description.")
    with tempfile.TemporaryDirectory(prefix="congrasp-") as folder:
        result = pathlib.Path(folder, "model.mjb")
        search = os.pathsep.join(filter(None, [str(_ROOT), os.environ.get("PYTHONPATH")]))
        command = [sys.executable, "-m", "congrasp.services.assets.hands.compile", str(path.resolve()), str(result)]
        try:
            subprocess.run(
                command,
                timeout=SECONDS,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                cwd=folder,
                env={**os.environ, "PYTHONPATH": search, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise CongraspError(f"{path} was not read within {SECONDS} s.", _REMEDY) from None
        try:
            said = json.loads(result.with_suffix(".json").read_text())
        except (OSError, ValueError):
            why = f"reading it takes more than {MEMORY >> 30} GB, or MuJoCo fails on it"
            raise CongraspError(f"{path} cannot be read: {why}.", _REMEDY) from None
        if "error" in said:
            raise CongraspError(f"{path} cannot be read: {said['error']}.", _REMEDY)
        notes += said["notes"]
        return mujoco.MjModel.from_binary_path(str(result))


def robot_spec(path: pathlib.Path, notes: list[str]) -> mujoco.MjSpec:
    """Returns the modifiable model of a URDF or MJCF file, after `compiled_model` has read it; raises the same
    errors.
    """
    compiled_model(path, notes)
    return _spec(path, [])


def _child(source: str, result: str) -> None:
    """Compiles a file into another; ends a few seconds after `SECONDS`, even if the parent is gone."""
    signal.alarm(SECONDS + 5)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    path, notes = pathlib.Path(source), list[str]()
    try:
        model = _compiled(path, notes)
        for name, most in LIMITS.items():
            if getattr(model, name) > most:
                raise ValueError(f"it has {getattr(model, name)} parts of the kind {name}, more than {most}")
        _check_values(model)
        mujoco.mj_saveModel(model, result)
        said: dict[str, object] = {"notes": notes}
    except MemoryError:
        said = {"error": f"it takes more than {MEMORY >> 30} GB"}
    except (ValueError, mujoco.FatalError) as error:
        said = {"error": (str(error).strip().splitlines() or ["MuJoCo gives no reason"])[0].rstrip(".")[:300]}
    pathlib.Path(result).with_suffix(".json").write_text(json.dumps(said))


def _check_values(model: mujoco.MjModel) -> None:
    """Raises a ValueError if a body or a joint has impossible values; a mass of zero means that the file omits it."""
    for name in _FINITE:
        values = getattr(model, name)
        if not np.isfinite(values).all():
            raise ValueError(f"its {name} holds numbers that are not finite")
    for name in ("body_mass", "body_inertia"):
        if (getattr(model, name) < 0).any():
            raise ValueError(f"its {name} holds numbers below zero")


def _spec(path: pathlib.Path, notes: list[str]) -> mujoco.MjSpec:
    """Returns the model of a file, not compiled; raises a ValueError or MuJoCo's error if it cannot be read."""
    for count in _COUNTS.findall(path.read_text(errors="replace")):
        if any(float(number) > MAX_COUNT for number in count.split()):
            raise ValueError(f"it repeats a part {count[:40]} times, more than {MAX_COUNT}")
    urdf = path.suffix.lower() == ".urdf"
    spec = _urdf(path, notes) if urdf else mujoco.MjSpec.from_file(str(path))
    spec.compiler.fusestatic = False
    for body in spec.bodies:
        if body.explicitinertial and body.mass < 0:
            raise ValueError(f"the body '{body.name[:60]}' has the mass {body.mass:g} kg")
    missing = [mesh for mesh in spec.meshes if not urdf and mesh.file and not _found(path, spec, mesh.file)]
    if missing:
        names = {mesh.name for mesh in missing}
        for geom in [geom for geom in spec.geoms if geom.meshname in names]:
            spec.delete(geom)
        for mesh in missing:
            spec.delete(mesh)
        notes.append(_missing(len(missing)))
    return spec


def _compiled(path: pathlib.Path, notes: list[str]) -> mujoco.MjModel:
    """Returns the compiled model of a file; raises like `_spec`."""
    spec = _spec(path, notes)
    try:
        return spec.compile()
    except ValueError as error:
        if "mass and inertia" not in str(error):
            raise
    spec.compiler.boundmass, spec.compiler.boundinertia = LEAST
    model = spec.compile()
    light = [model.body(i).name for i in np.flatnonzero(model.body_mass == LEAST[0])]
    notes.append(f"links without mass get {1e3 * LEAST[0]:g} g ('<inertial>' in the file): {', '.join(light)}")
    return model


def _urdf(path: pathlib.Path, notes: list[str]) -> mujoco.MjSpec:
    """Returns the model of a URDF file; searches its meshes as ROS does, and converts formats that MuJoCo lacks."""
    try:
        robot = ET.fromstring(path.read_text(errors="replace"))
    except ET.ParseError as error:
        raise ValueError(f"XML Error: {error}") from None
    extension = robot.find("mujoco") or ET.SubElement(robot, "mujoco")
    compiler = extension.find("compiler")
    compiler = ET.SubElement(extension, "compiler") if compiler is None else compiler
    compiler.attrib |= {"strippath": "false", "discardvisual": "false", "balanceinertia": "true", "meshdir": ""}
    assets, lacking = dict[str, bytes](), set[str]()
    for link in robot.iter("link"):
        for again in link.findall("inertial")[1:]:
            link.remove(again)
        for shape in (*link.findall("visual"), *link.findall("collision")):
            for mesh in shape.iter("mesh"):
                file = _mesh_file(path, mesh.get("filename", ""))
                content = _readable(file) if file else b""
                if file is None or not content:
                    lacking.add(mesh.get("filename", ""))
                    link.remove(shape)
                    break
                name = f"{len(assets)}.{'stl' if file.suffix.lower() not in _NATIVE else file.suffix[1:].lower()}"
                assets[name] = content
                mesh.set("filename", name)
    if lacking:
        notes.append(_missing(len(lacking)))
    return mujoco.MjSpec.from_string(ET.tostring(robot, "unicode"), assets=assets)


def _mesh_file(path: pathlib.Path, name: str) -> pathlib.Path | None:
    """Path of a mesh named in a URDF file, relative to it or to a parent folder; None if there is none."""
    plain = name.removeprefix("file://").removeprefix("package://").removeprefix("model://")
    above = [path.parent, *path.parent.parents[:3]]
    parts = pathlib.PurePosixPath(plain).parts
    within = [plain, *("/".join(parts[i:]) for i in range(1, len(parts)))] if parts else []
    return next((file for folder in above for part in within if (file := folder / part).is_file()), None)


def _readable(file: pathlib.Path) -> bytes:
    """Content of a mesh in a format that MuJoCo reads, or nothing."""
    if file.stat().st_size > MAX_FILE:
        return b""
    if file.suffix.lower() in _NATIVE:
        return file.read_bytes()
    try:
        scene = trimesh.load_scene(file)
        # COLLADA states its unit. Its upward axis is ignored, as in ROS.
        scene = scene.convert_units("meters") if file.suffix.lower() == ".dae" else scene
        return trimesh.exchange.stl.export_stl(scene.to_mesh())
    except Exception:  # readers of many formats raise arbitrary errors
        return b""


def _missing(count: int) -> str:
    """Note on missing meshes."""
    return f"{count} meshes were not found or cannot be read: results without them are approximate"


def _found(path: pathlib.Path, spec: mujoco.MjSpec, file: str) -> bool:
    """True if a mesh file is at the model's path, or next to the model."""
    folder = path.parent / (spec.compiler.meshdir or "")
    return (folder / file).exists() or (folder / pathlib.Path(file).name).exists()


if __name__ == "__main__":
    _child(*sys.argv[1:])
