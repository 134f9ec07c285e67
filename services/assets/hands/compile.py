"""Reads robot descriptions, URDF or MJCF, with MuJoCo; those of strangers in a confined process."""

import contextlib
import math
import os
import pathlib
import re
import shlex
import stat
import tempfile
import urllib.parse
import xml.etree.ElementTree as ET
import xml.parsers.expat
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import trimesh

from congrasp.common.errors import CongraspError
from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.assets.confined import call_confined
from congrasp.services.assets.objects.file_kinds import SUFFIXES
from congrasp.services.assets.objects.mesh_files import load_geometry

MEMORY = 3 << 30
"""Limit of the address space for reading a file, bytes."""
SECONDS = 30
"""Limit of the processor time for reading a file, s."""
MAX_FILE = 64 << 20
"""Limit of a file, bytes."""
MAX_COUNT = 1000
"""Largest count of a replicate, composite or flexcomp in the file; nested ones are bounded by the
limits above.
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
LEAST = 1e-3, 1e-7
"""Mass (kg) and inertia (kg m2) of moving links without mass."""
_BALL = 0.4 * 0.02**2  # kg m2 for each kg: inertia of a ball with the radius of a finger link
_KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar", "spherical")
_INERTIA = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
_DECIMAL = re.compile(r"(?<!\S)[-+]?\d+(?:\.\d*)?(?!\S)")
# Rad, largest angle of a joint's frame, but for multiples of a right one
_TURN, _RIGHT = (
    7.0,
    math.pi / 2,
)
_FLAT = 1e-6  # of a mesh's length: thickness below which it has no hull
_START = 30  # s, for the child's imports on a busy machine
_MOST_FILES = 300  # that a description names
_COUNTS = re.compile(r"""\bcount\s*=\s*["']([^"']*)["']""")
_NAMED = re.compile(r"""<(\w+)[^<>]*?\bfile\w*\s*=\s*["']([^"']+)["']""")
_FOLDERS = re.compile(r"""\b(?:meshdir|texturedir|assetdir)\s*=\s*["']([^"']+)["']""")
_CLASSES = re.compile(r"""<default\b[^<>]*?\bclass\s*=\s*["']([^"']+)["']""")
_OPENING = re.compile(r"opening file '(.*)'")
_REASONS = {
    "coplanar|too small": "flat",
    "decoder": "not readable",
    "orient": "inside out",
    "": "rejected by MuJoCo",
}
# Up to the root element
_PROLOG = re.compile(r"<!--.*?(?:-->|\Z)|<\?.*?(?:\?>|\Z)|<!ENTITY|<(?!!)", re.DOTALL)
_XACRO = re.compile(r"<xacro:|\$\{|\$\((?:find|arg|eval)\b")
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
    ),
    *("geom_size", "geom_quat", "mesh_vert", "dof_armature", "dof_damping", "actuator_biasprm"),
    "actuator_forcerange",
)
# Most triangles of a mesh; MuJoCo's limit is 200,000, but two arms must fit into the memory
_FACES = 50_000
_FEWER_FACES = 20_000  # of a mesh with more than that
_REMEDY = "MuJoCo must be able to load it."


@contextlib.contextmanager
def confined(
    function: Callable[..., Any], path: pathlib.Path, options: dict[str, Any]
) -> Iterator[tuple[Any, pathlib.Path]]:
    """Calls a function of a module with a robot description, in a confined process.

    Args:
      function: called as function(folder, path, **options); writes arrays into the folder, and
        returns what JSON takes.
      path: the description.
      options: further arguments, as JSON takes them.

    Yields:
      The function's answer, and the folder.

    Raises:
      CongraspError: of the function; or the file is missing, or takes more than `MEMORY` or
        `SECONDS`.
    """
    if not path.is_file():
        raise CongraspError(f"There is no file {path}.", "Check the path.")
    if path.stat().st_size > MAX_FILE:
        raise CongraspError(
            f"{path} has more than {MAX_FILE >> 20} MB.", "Pass a robot description."
        )
    options, limits = (
        {"path": str(path), **options},
        {"seconds": SECONDS, "patience": SECONDS + _START},
    )
    with tempfile.TemporaryDirectory(prefix="congrasp-") as name:
        folder = pathlib.Path(name)
        try:
            answer = call_confined(function, folder, options, memory=MEMORY, **limits)
        except TimeoutError:
            raise CongraspError(
                f"{path} was not read within {SECONDS + _START:g} s.", _REMEDY
            ) from None
        except ChildProcessError as error:
            why = f"reading it {error}; the limits are {SECONDS} s and {MEMORY >> 30} GB"
            raise CongraspError(f"{path} cannot be read: {why}.", _REMEDY) from None
        yield answer, folder


def robot_spec(path: pathlib.Path, notes: list[str]) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """Reads a URDF or MJCF file, whose root element determines which it is.

    Args:
      path: the file. A stranger's belongs into a function of `confined`.
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
        for name, most in LIMITS.items():
            if getattr(model, name) > most:
                raise ValueError(
                    f"it has {getattr(model, name)} parts of the kind {name}, more than {most}"
                )
        for name in _FINITE:
            if not np.isfinite(getattr(model, name)).all():
                raise ValueError(f"its {name} holds numbers that are not finite")
        for name in ("body_mass", "body_inertia"):
            if (getattr(model, name) < 0).any():
                raise ValueError(f"its {name} holds numbers below zero")
    except (ValueError, OSError, MemoryError, RuntimeError, mujoco.FatalError) as error:
        raise CongraspError(_unread(path, error)) from None
    return spec, model


def listed(what: str, names: Sequence[str]) -> list[str]:
    """Returns a note on parts of a robot, if there are any of these names."""
    return [f"{what}: {', '.join(names)}"] if names else []


def _unread(path: pathlib.Path, error: Exception) -> str:
    """One line about an error of reading; MuJoCo's begins with its kind, and names the element in
    the second line.
    """
    lines = [line.strip().rstrip(".") for line in str(error).splitlines() if line.strip()]
    reason = re.sub(r"^(?:(?:XML )?Error: )+", "", ", ".join(lines)) or "MuJoCo gives no reason"
    remedy = f" {_REMEDY}"
    if isinstance(error, _Known):
        remedy = ""
    elif re.search("plugin (?:.+ not found|instance)|'plugin' nor", reason):
        remedy = (
            f" Correct the plugin, or delete it and what uses it: MuJoCo {mujoco.__version__} has "
            f"only its own."
        )
    elif "unknown default class" in reason:
        remedy = " If another file includes this one, import that."
    elif "unrecognized attribute" in reason or "unrecognized element" in reason:
        remedy = f" MuJoCo {mujoco.__version__} has none of that name: delete it."
    elif re.search(
        "unknown exception|allocate memory|no reason", reason
    ):  # as it words an exception of C++
        reason = (
            f"MuJoCo gives no reason; its meshes, pictures or height fields may need more than "
            f"{MEMORY >> 30} GB"
        )
        remedy = " Cut the hand out of the file, or name meshes of fewer triangles."
    return f"{path} cannot be read: {reason[:400]}.{remedy}"


class _Known(ValueError):
    """A fault with its remedy."""


def _spec(path: pathlib.Path, notes: list[str]) -> mujoco.MjSpec:  # noqa: C901
    """The model of a file, not compiled; raises a ValueError or an OSError if it cannot be read."""
    text, included, attached = _texts(path)
    texts = [text, *included.values(), *attached.values()]
    for count in _COUNTS.findall("\n".join(texts)):
        if any(float(number) > MAX_COUNT for number in count.split()):
            raise ValueError(f"it repeats a part {count[:40]} times, more than {MAX_COUNT}")
    root = re.search(r"<\s*([A-Za-z_][\w:.-]*)", text)
    kind = root[1] if root else ""
    if kind == "robot" and _XACRO.search(re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)):
        stem = path.name.partition(".")[0]
        plain = f"{stem}.urdf" if path.suffix == ".xacro" else f"{stem}_plain.urdf"
        raise _Known(
            f"this is xacro, of which ROS makes a URDF. Run "
            f"'xacro {shlex.quote(path.name)} > {shlex.quote(plain)}' and "
            f"import that"
        )
    if kind == "robot":
        spec = _urdf(path, text, notes)
    elif kind == "mujocoinclude":
        raise _Known("it is a part of an MJCF. Import the file that includes it")
    elif kind == "mujoco":
        try:
            files = {name: other.encode() for name, other in included.items()}
            spec = mujoco.MjSpec.from_string(text, include=files)
        except ValueError as error:
            raise ValueError(f"{error} {_repeated_classes(texts, str(error))}") from None
        spec.modelfiledir = str(path.parent)
    else:
        what = f"its root element is '{kind[:40]}'" if kind else "it is no XML"
        raise _Known(f"{what}, not robot (URDF) or mujoco (MJCF). Export the robot as one of these")
    spec.compiler.fusestatic = False
    # What the file reserves is of no use here, and may be more than there is.
    spec.memory, spec.nuserdata, spec.nkey = -1, 0, 0
    for name in (
        "njmax",
        "nconmax",
        "nstack",
        *(name for name in dir(spec) if name.startswith("nuser_")),
    ):
        setattr(spec, name, -1)
    for group in (spec.sensors, spec.cameras, spec.lights, spec.numerics, spec.texts, spec.tuples):
        for element in list(group):
            spec.delete(element)
    for body in spec.bodies:
        if body.explicitinertial and body.mass < 0:
            raise ValueError(f"the body '{body.name[:60]}' has the mass {body.mass:g} kg")
    for asset in (*spec.meshes, *spec.textures, *spec.hfields, *spec.skins):
        if "\\" in asset.file:
            asset.file = asset.file.replace("\\", "/")
    return spec


def _texts(path: pathlib.Path) -> tuple[str, dict[str, str], dict[str, str]]:
    """The texts of a description and of the XML files that it includes, and attaches, by their
    names in it.

    Raises:
      ValueError: it names a pipe or a device, which would block, or too many files.
    """
    todo, found = [("", robot_text(path))], {"include": dict[str, str](), "model": dict[str, str]()}
    for name, text in todo:
        folders = {"", *_FOLDERS.findall(text), str(pathlib.PurePath(name).parent)}
        for tag, file in _NAMED.findall(text):
            file = file.replace("\\", "/")
            for folder in folders:
                there = path.parent / folder / file
                if there.exists() and not stat.S_ISREG(there.stat().st_mode):
                    raise _Known(
                        f"the file '{file}' that it names is no regular file. Name one that is"
                    )
            if tag in found and file not in found[tag] and (path.parent / file).is_file():
                found[tag][file] = robot_text(path.parent / file)
                todo.append((file, found[tag][file]))
                if len(todo) > _MOST_FILES:
                    raise ValueError(f"it names more than {_MOST_FILES} files")
    return todo[0][1], found["include"], found["model"]


def robot_text(path: pathlib.Path) -> str:
    """The text of an XML file from its first element on, in whatever encoding."""
    if path.stat().st_size > MAX_FILE:
        raise ValueError(f"{path.name} has more than {MAX_FILE >> 20} MB")
    data = path.read_bytes()
    named = re.match(rb"""[^>]{0,200}?encoding\s*=\s*["']([\w-]+)""", data)
    wide = {
        b"\xff\xfe": "utf-16",
        b"\xfe\xff": "utf-16",
        b"<\0": "utf-16-le",
        b"\0<": "utf-16-be",
    }.get(data[:2])
    encoding = wide or (named[1].decode() if named else "utf-8-sig")
    try:
        text = data.decode(
            "utf-8-sig" if encoding.lower() in ("utf-8", "utf8") else encoding, errors="replace"
        )
    except LookupError:
        raise ValueError(f"{path.name} has the unknown encoding '{encoding[:30]}'") from None
    for mark in _PROLOG.finditer(text):
        if mark[0] == "<":
            return text[mark.start() :]
        if mark[0] == "<!ENTITY":
            raise _Known(
                f"{path.name} declares entities, which are not read. Export it without a DOCTYPE"
            )
    return ""


def _repeated_classes(texts: list[str], error: str) -> str:
    """Names of default classes that occur more than once, if the error is about them."""
    if "repeated default class" not in error:
        return ""
    counts = Counter(name for text in texts for name in _CLASSES.findall(text))
    return "repeated: " + ", ".join(f"'{name}'" for name, count in counts.items() if count > 1)


def _compiled(spec: mujoco.MjSpec, notes: list[str]) -> mujoco.MjModel:
    """The compiled model, without missing files and unusable meshes; raises a ValueError."""
    bounded, errors, lacking = False, list[ValueError](), dict[str, list[str]]()  # by the reason
    for i, mesh in enumerate(spec.meshes):
        # MuJoCo's errors end with it, and do not name the kind of their element
        mesh.info = f"{mesh.info} (mesh {i})"
    while True:  # until there is nothing more to leave out
        try:
            model = spec.compile()
            break
        except ValueError as error:
            asset, why, name = _rejected(spec, str(error))
            if "mass and inertia" in str(error) and not bounded:
                spec.compiler.boundmass, spec.compiler.boundinertia = LEAST
                bounded = True
            elif asset:
                errors.append(error)
                lacking.setdefault(why, []).append(name)
                _leave_out(spec, asset)
            else:  # a pair or a tendon may name a geom that was left out
                raise (errors[0] if errors and "geom '" in str(error) else error) from None
    notes += [_missing(why, files) for why, files in lacking.items()]
    if bounded:
        light, thin = model.body_mass == LEAST[0], (model.body_inertia == LEAST[1]).any(1)
        given = (
            (light, f"mass get {1e3 * LEAST[0]:g} g"),
            (thin & ~light, f"inertia get {1e6 * LEAST[1]:g} kg.mm²"),
        )
        for links, text in given:
            what = f"links without {text} ('<inertial>' in the file), as do those with less"
            notes += listed(what, [model.body(i).name for i in np.flatnonzero(links)])
    return model


def _rejected(spec: mujoco.MjSpec, error: str) -> tuple[Any, str, str]:
    """The asset that MuJoCo's error is about, the reason and a name; None if there is no such
    asset.
    """
    if opened := _OPENING.search(error):
        folders = (
            (spec.meshdir, (*spec.meshes, *spec.hfields, *spec.skins)),
            (spec.texturedir, spec.textures),
        )
        files = {
            name: (asset, os.path.normpath(os.path.join(folder, name)))
            for folder, assets in folders
            for asset in assets
            for name in (asset.file, *getattr(asset, "cubefiles", ()))
            if name
        }
        if same := [
            name
            for name in files
            if pathlib.PurePath(name).name == pathlib.PurePath(opened[1]).name
        ]:
            name = max(
                same,
                key=lambda name: (files[name][1] == opened[1], opened[1].endswith(name), len(name)),
            )
            return files[name][0], "not found", name
    mesh = next((mesh for mesh in spec.meshes if error.endswith(mesh.info)), None)
    why = next(
        why for pattern, why in _REASONS.items() if re.search(pattern, error.partition("\n")[0])
    )
    return mesh, why, mesh.name if mesh else ""


def _leave_out(spec: mujoco.MjSpec, asset: Any) -> None:
    """Removes an asset, and what shows it."""
    field = {mujoco.MjsMesh: "meshname", mujoco.MjsHField: "hfieldname"}.get(type(asset), "")
    for geom in [
        geom for geom in spec.geoms if field and asset.name and getattr(geom, field) == asset.name
    ]:
        spec.delete(geom)
    for material in spec.materials if isinstance(asset, mujoco.MjsTexture) else ():
        material.textures = ["" if name == asset.name else name for name in material.textures]
    spec.delete(asset)


def _urdf(path: pathlib.Path, text: str, notes: list[str]) -> mujoco.MjSpec:
    """Returns the model of a URDF file; searches its meshes as ROS does, and converts formats that
    MuJoCo lacks.
    """
    # Which, as ROS, declares no prefixes
    tree, parser = (
        ET.TreeBuilder(),
        xml.parsers.expat.ParserCreate(),
    )
    parser.StartElementHandler, parser.EndElementHandler = tree.start, tree.end
    parser.CharacterDataHandler = tree.data  # MuJoCo counts lines
    try:
        parser.Parse(text, True)
    except xml.parsers.expat.ExpatError as error:
        raise ValueError(f"XML Error: {error}") from None
    robot = tree.close()
    extension = robot.find("mujoco")
    extension = ET.SubElement(robot, "mujoco") if extension is None else extension
    compiler = extension.find("compiler")
    compiler = ET.SubElement(extension, "compiler") if compiler is None else compiler
    compiler.attrib |= {
        "strippath": "false",
        "discardvisual": "false",
        "balanceinertia": "true",
        "meshdir": "",
    }
    for kind in ("link", "joint"):  # of joints, MuJoCo would leave all but one without a name
        names = Counter(element.get("name") for element in robot.findall(kind))
        if repeated := [name for name, count in names.items() if count > 1]:
            raise _Known(f"several {kind}s are called '{repeated[0]}'. Rename all but one")
    _check_joints(robot, notes)
    children = Counter(child.get("link") for child in robot.findall("joint/child"))
    if held := [name for name, count in children.items() if count > 1]:
        raise _Known(
            f"the link '{held[0]}' is the child of several joints. Remove all but one of them"
        )
    if robot.find("link") is not None and all(
        link.get("name") in children for link in robot.findall("link")
    ):
        raise _Known("its links form a loop, and none is the root. Remove the joint that closes it")
    _complete_inertias(robot, notes)
    assets, shared = dict[str, bytes](), dict[tuple[pathlib.Path | None, str], str]()
    lacking = dict[str, dict[str, None]]()  # by the reason
    for link in robot.iter("link"):
        for i, shape in enumerate((*link.findall("visual"), *link.findall("collision"))):
            # For errors; those of the file may be equal
            shape.set("name", f"shape {i} of {link.get('name')}")
            for mesh in shape.iter("mesh"):
                file = _mesh_file(path, mesh.get("filename", ""))
                # MuJoCo shares a mesh among shapes of one name and scale
                used = (
                    file,
                    mesh.get("scale", ""),
                )
                if used not in shared:
                    content, kind = _readable(file) if file else (b"", "not found")
                    shared[used] = f"{len(assets)} {file and file.stem}.{kind}" if content else kind
                    assets |= {shared[used]: content} if content else {}
                if shared[used] not in assets:
                    lacking.setdefault(shared[used], {})[mesh.get("filename", "")] = None
                    link.remove(shape)
                    break
                mesh.set("filename", shared[used])
    notes += [_missing(why, list(files)) for why, files in lacking.items()]
    return mujoco.MjSpec.from_string(ET.tostring(robot, "unicode"), assets=assets)


def _check_joints(robot: ET.Element, notes: list[str]) -> None:  # noqa: C901
    """Refuses missing links, limits in the wrong order and frames in degrees.

    Removes limits of effort below zero, and mimics that MuJoCo would drop.
    """
    links = {link.get("name") for link in robot.findall("link")}
    kinds = {joint.get("name"): joint.get("type") for joint in robot.findall("joint")}
    for joint in robot.findall("joint"):
        for angle in (
            x for origin in joint.findall("origin") for x in _DECIMAL.findall(origin.get("rpy", ""))
        ):
            if abs(float(angle)) > _TURN and not (float(angle) + 1e-3) % _RIGHT < 2e-3:
                raise _Known(
                    f"rpy of the joint '{joint.get('name', '')}' has {angle}. Write radians, not "
                    f"degrees"
                )
        name, limit, mimic = joint.get("name", ""), joint.find("limit"), joint.find("mimic")
        if (kind := joint.get("type", "")) not in _KINDS:
            raise _Known(
                f"the type of the joint '{name}' is '{kind[:40]}'. Write one of: "
                f"{', '.join(_KINDS)}"
            )
        for end in ("parent", "child"):
            link = None if (element := joint.find(end)) is None else element.get("link")
            if link not in links:
                raise _Known(
                    f"the {end} of the joint '{name}' is the link '{link}', which does not exist. "
                    f"Correct it"
                )
        if limit is not None:
            lower, upper = (_value(limit, end, joint) for end in ("lower", "upper"))
            if lower > upper:
                raise _Known(
                    f"the lower limit {lower:g} of the joint '{name}' is above the upper "
                    f"{upper:g}. Swap them"
                )
            for bound in ("effort", "velocity"):
                if _value(limit, bound, joint) < 0:
                    limit.set(bound, "0")
        if mimic is None:
            continue
        leader = mimic.get("joint", "")
        why = {None: "which does not exist", "fixed": "which is fixed"}.get(kinds.get(leader), "")
        if leader == name:
            why = "which is itself"
        elif not _value(mimic, "multiplier", joint, 1.0):
            why = "with the multiplier 0"
        if why:
            joint.remove(mimic)
            notes.append(
                f"'{name}' mimics '{leader}', {why}: it has a motor of its own ('couplings' in the "
                f"hand file)"
            )


def _complete_inertias(robot: ET.Element, notes: list[str]) -> None:
    """Removes repeated inertials and those without mass; adds the elements of inertia that MuJoCo
    requires.
    """
    guessed, raised, weightless = list[str](), list[str](), list[str]()
    for link in robot.findall("link"):
        found = link.findall("inertial")
        for inertial in found[1:]:
            link.remove(inertial)
        if not found:
            continue
        mass = found[0].find("mass")
        if mass is None or mass.get("value") is None:
            link.remove(found[0])
            weightless.append(link.get("name", ""))
            continue
        if (weight := _value(mass, "value", link)) < 0:
            raise _Known(
                f"the mass of the link '{link.get('name', '')[:40]}' is {weight:g}, below zero. "
                f"Correct it"
            )
        inertia = found[0].find("inertia")
        inertia = ET.SubElement(found[0], "inertia") if inertia is None else inertia
        given = [value for name in _INERTIA[:3] if (value := _value(inertia, name, link))]
        if weight and len(given) < 2:
            inertia.attrib = dict.fromkeys(_INERTIA[:3], str(_BALL * weight))
            guessed.append(link.get("name", ""))
        elif weight and len(given) == 2:  # an axis has at least the difference of the others
            zero = next(name for name in _INERTIA[:3] if not _value(inertia, name, link))
            inertia.set(zero, str(abs(given[0] - given[1]) + min(LEAST[1], *given)))
            raised.append(link.get("name", ""))
        for name in _INERTIA:
            inertia.set(name, str(_value(inertia, name, link)))
    what = "links with one axis of inertia or without '<inertia>'"
    notes += listed(f"{what} get that of a ball of their mass, 4 cm wide", guessed)
    notes += listed(
        "links with inertia about two axes get the least possible about the third", raised
    )
    notes += listed("'<inertial>' without mass, which follows from the link's shapes", weightless)


def _value(element: ET.Element, name: str, owner: ET.Element, missing: float = 0.0) -> float:
    """A number of an element of a joint or link."""
    text = element.get(name, str(missing))
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        whose = f"the {owner.tag} '{owner.get('name', '')[:40]}'"
        raise _Known(f"{name} of {whose} is '{text[:40]}', not a finite number. Correct it")
    return value


def _mesh_file(path: pathlib.Path, name: str) -> pathlib.Path | None:
    """Path of a mesh named in a URDF file, relative to it or to a parent folder; None if there is
    none.
    """
    plain = urllib.parse.unquote(re.sub(r"^(?:file|package|model)://", "", name.strip())).replace(
        "\\", "/"
    )
    above = [path.parent, *path.parent.parents[:3]]
    parts = pathlib.PurePosixPath(plain).parts
    within = [plain, *("/".join(parts[i:]) for i in range(1, len(parts)))] if parts else []
    return next(
        (file for folder in above for part in within if (file := _there(folder / part))), None
    )


def _there(path: pathlib.Path) -> pathlib.Path | None:
    """The file at a path, or one whose name differs in upper and lower case alone; None if there is
    none.
    """
    files = (file for files in ([path], path.parent.glob("*")) for file in files)
    return next(
        (file for file in files if file.name.lower() == path.name.lower() and file.is_file()), None
    )


def _readable(file: pathlib.Path) -> tuple[bytes, str]:
    """Content of a mesh in a format that MuJoCo reads, and its suffix; or nothing, and the
    reason.
    """
    suffix = file.suffix.lower()
    if file.stat().st_size > MAX_FILE:
        return b"", f"larger than {MAX_FILE >> 20} MB"
    if suffix == ".msh":
        return file.read_bytes(), "msh"
    try:
        known = suffix in SUFFIXES
        loaded: Any = (
            load_geometry(file, "", skip_materials=True) if known else trimesh.load_scene(file)
        )
        if cloud := isinstance(loaded, trimesh.PointCloud):
            mesh = trimesh.Trimesh(loaded.vertices, process=False)
        else:
            # COLLADA states its unit. Its upward axis is ignored, as in ROS.
            mesh = (
                loaded.convert_units("meters") if suffix == ".dae" else trimesh.Scene(loaded)
            ).to_mesh()
        if not (cloud or len(mesh.faces)):
            return b"", "without faces"
        if len(mesh.faces) > _FACES:
            mesh.merge_vertices(merge_tex=True, merge_norm=True)
            mesh = mesh.simplify_quadric_decimation(face_count=_FEWER_FACES)
        spread = np.linalg.svd(mesh.vertices - mesh.vertices.mean(0), compute_uv=False)
        if spread[-1] <= _FLAT * spread[0]:  # MuJoCo would refuse the whole file
            return b"", "flat"
        return trimesh.exchange.stl.export_stl(mesh.convex_hull if cloud else mesh), "stl"
    except Exception:  # readers of many formats raise arbitrary errors
        return b"", "not readable"


def _missing(why: str, files: list[str]) -> str:
    """Note on files that are left out."""
    some = ", ".join(files[:5]) + (f" and {len(files) - 5} more" if len(files) > 5 else "")
    return f"{why}, results without them are approximate: {some}"
