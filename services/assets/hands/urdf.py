"""URDF files: checked, completed, and converted to models of MuJoCo."""

import pathlib
import re
import shlex
import xml.etree.ElementTree as ET
import xml.parsers.expat
from collections import Counter

from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.assets.hands.reading import FaultyFile, missing_files
from congrasp.services.assets.hands.urdf_inertias import complete_inertias
from congrasp.services.assets.hands.urdf_joints import check_joints
from congrasp.services.assets.hands.urdf_meshes import find_mesh, read_as_mujoco_does

_XACRO = re.compile(r"<xacro:|\$\{|\$\((?:find|arg|eval)\b")
_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_COMPILER = {
    "strippath": "false",
    "discardvisual": "false",
    "balanceinertia": "true",
    "meshdir": "",
}


class _Meshes:
    """Meshes of a URDF file by the names that MuJoCo gets."""

    def __init__(self, path: pathlib.Path):
        """Takes the path of the URDF file."""
        self.assets: dict[str, bytes] = {}
        """Contents by name."""
        self.left_out: dict[str, dict[str, None]] = {}
        """Names in the file of meshes that cannot be used, by the reason, in order."""
        self._path = path
        self._names: dict[tuple[pathlib.Path | None, str], str] = {}

    def add(self, mesh: ET.Element) -> bool:
        """Reads a mesh and renames it; returns False if it cannot be used.

        MuJoCo shares a mesh among shapes of one name and scale.
        """
        name_in_file = mesh.get("filename", "")
        file = find_mesh(self._path, name_in_file)
        key = (file, mesh.get("scale", ""))
        if key not in self._names:
            self._names[key] = self._read(file)
        name = self._names[key]
        if name not in self.assets:
            self.left_out.setdefault(name, {})[name_in_file] = None
            return False
        mesh.set("filename", name)
        return True

    def _read(self, file: pathlib.Path | None) -> str:
        """Name of the mesh of a file; the reason if it cannot be used."""
        if file is None:
            return "not found"
        content, suffix_or_reason = read_as_mujoco_does(file)
        if not content:
            return suffix_or_reason
        name = f"{len(self.assets)} {file.stem}.{suffix_or_reason}"
        self.assets[name] = content
        return name


def check_no_xacro(path: pathlib.Path, text: str) -> None:
    """Raises a FaultyFile for a text of xacro."""
    if not _XACRO.search(_COMMENT.sub("", text)):
        return
    stem = path.name.partition(".")[0]
    urdf = f"{stem}.urdf" if path.suffix == ".xacro" else f"{stem}_plain.urdf"
    command = f"xacro {shlex.quote(path.name)} > {shlex.quote(urdf)}"
    raise FaultyFile(f"this is xacro, of which ROS makes a URDF. Run '{command}' and import that")


def urdf_spec(path: pathlib.Path, text: str, notes: list[str]) -> mujoco.MjSpec:
    """Returns the model of a URDF file.

    Args:
      path: the file; meshes are searched from there, as ROS does, and those of formats that MuJoCo
        lacks are converted.
      text: its text.
      notes: omissions and proposals are appended.

    Raises:
      ValueError: it cannot be read.
    """
    robot = parse_urdf(text)
    extension = _child(robot, "mujoco")
    _child(extension, "compiler").attrib.update(_COMPILER)
    _check_names(robot)
    check_joints(robot, notes)
    _check_tree(robot)
    complete_inertias(robot, notes)
    meshes = _Meshes(path)
    for link in robot.iter("link"):
        _name_shapes(link, meshes)
    notes += [missing_files(reason, list(files)) for reason, files in meshes.left_out.items()]
    return mujoco.MjSpec.from_string(ET.tostring(robot, "unicode"), assets=meshes.assets)


def parse_urdf(text: str) -> ET.Element:
    """Returns the root element of a URDF's text.

    As in ROS, prefixes need no declaration, which ElementTree requires.

    Raises:
      ValueError: it is not XML.
    """
    builder = ET.TreeBuilder()
    parser = xml.parsers.expat.ParserCreate()
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data  # MuJoCo counts lines
    try:
        parser.Parse(text, True)
    except xml.parsers.expat.ExpatError as error:
        raise ValueError(f"XML Error: {error}") from None
    return builder.close()


def _child(element: ET.Element, tag: str) -> ET.Element:
    """The child element of this tag, which is added if there is none."""
    child = element.find(tag)
    return ET.SubElement(element, tag) if child is None else child


def _check_names(robot: ET.Element) -> None:
    """Raises a FaultyFile for links or joints of one name.

    MuJoCo would leave all joints but one without a name.
    """
    for kind in ("link", "joint"):
        names = Counter(element.get("name") for element in robot.findall(kind))
        for name, count in names.items():
            if count > 1:
                raise FaultyFile(f"several {kind}s are called '{name}'. Rename all but one")


def _check_tree(robot: ET.Element) -> None:
    """Raises a FaultyFile for links with two parents, and for a loop of links."""
    parents = Counter(child.get("link") for child in robot.findall("joint/child"))
    for name, count in parents.items():
        if count > 1:
            raise FaultyFile(
                f"the link '{name}' is the child of several joints. Remove all but one of them"
            )
    links = robot.findall("link")
    if links and all(link.get("name") in parents for link in links):
        raise FaultyFile(
            "its links form a loop, and none is the root. Remove the joint that closes it"
        )


def _name_shapes(link: ET.Element, meshes: _Meshes) -> None:
    """Names the shapes of a link, and removes those whose mesh cannot be used.

    The names are for errors; those of the file may be equal.
    """
    shapes = [*link.findall("visual"), *link.findall("collision")]
    for i, shape in enumerate(shapes):
        shape.set("name", f"shape {i} of {link.get('name')}")
        if not all(meshes.add(mesh) for mesh in shape.iter("mesh")):
            link.remove(shape)
