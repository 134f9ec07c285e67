"""USD as text (.usda) with time samples; written here, read back by Pixar's own library.

One Xform a link, nested as the hand is; capsules are USD's own, the object is a mesh.
"""

import json
import pathlib
from collections.abc import Iterable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from services.export.frames import OBJECT, Track, bodies, facts, identifiers, quaternions
from services.export.motion_file import GraspMotion

_COLOURS = {"hand": (0.70, 0.73, 0.79), OBJECT: (0.95, 0.62, 0.24)}
_NAME = "congrasp:name"


def write(path: pathlib.Path, motions: Sequence[GraspMotion]) -> None:
    """Writes one motion."""
    (motion,) = motions
    about = facts(motion, frame="z up (upAxis)", unit="m (metersPerUnit = 1)", quaternion="w, x, y, z")
    head = [
        "#usda 1.0",
        "(",
        '    defaultPrim = "grasp"',
        "    metersPerUnit = 1",
        '    upAxis = "Z"',
        "    startTimeCode = 0",
        f"    endTimeCode = {len(motion.time) - 1}",
        f"    timeCodesPerSecond = {_number(1 / motion.control_dt)}",
        f"    framesPerSecond = {_number(1 / motion.control_dt)}",
        f"    customLayerData = {{ string congrasp = {json.dumps(json.dumps(about))} }}",
        ")",
        'def Xform "grasp"',
        "{",
    ]
    found = bodies(motion)
    names = identifiers([body.name for body in found])
    lines: list[str] = []

    def add(index: int, indent: str) -> None:
        body = found[index]
        inner = indent + "    "
        turns = map(_quaternion, quaternions(body.rotation, scalar_first=True))
        lines.extend([f'{indent}def Xform "{names[index]}"', f"{indent}{{"])
        lines.append(f"{inner}custom string {_NAME} = {json.dumps(body.name)}")
        if len(body.translation) > 1:
            samples = _samples(map(_tuple, body.translation))
            lines.append(f"{inner}double3 xformOp:translate.timeSamples = {samples}")
        else:
            lines.append(f"{inner}double3 xformOp:translate = {_tuple(body.translation[0])}")
        lines.append(f"{inner}quatd xformOp:orient.timeSamples = {_samples(turns)}")
        lines.append(f'{inner}uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient"]')
        lines.extend(inner + line for line in (_mesh(motion) if body.name == OBJECT else _capsules(motion, index)))
        for child, other in enumerate(found):
            if other.parent == index:
                add(child, inner)
        lines.append(f"{indent}}}")

    for index, body in enumerate(found):
        if body.parent < 0:
            add(index, "    ")
    path.write_text("\n".join([*head, *lines, "}", ""]), encoding="utf-8")


def _number(value: float) -> str:
    return f"{value:.9g}"


def _tuple(values: Iterable[float]) -> str:
    return f"({', '.join(map(_number, values))})"


def _quaternion(values: Iterable[float]) -> str:
    """In full, because readers take the angle from the first number's arc cosine."""
    return f"({', '.join(f'{value:.17g}' for value in values)})"


def _samples(values: Iterable[str]) -> str:
    return f"{{ {', '.join(f'{i}: {value}' for i, value in enumerate(values))} }}"


def _capsules(motion: GraspMotion, link: int) -> list[str]:
    lines = []
    for k in np.flatnonzero(motion.capsule_link == link):
        (start, end), radius = motion.capsule_ends[k].astype(float), float(motion.capsule_radius[k])
        along = end - start
        length = float(np.linalg.norm(along))
        turn = Rotation.align_vectors([along], [[0, 0, 1]])[0] if length else Rotation.identity()
        half = length / 2 + radius
        lines += [
            f'def Capsule "capsule_{k}"',
            "{",
            '    uniform token axis = "Z"',
            f"    double height = {_number(length)}",
            f"    double radius = {_number(radius)}",
            f"    float3[] extent = [{_tuple([-radius, -radius, -half])}, {_tuple([radius, radius, half])}]",
            f"    color3f[] primvars:displayColor = [{_tuple(_COLOURS['hand'])}]",
            f"    double3 xformOp:translate = {_tuple((start + end) / 2)}",
            f"    quatd xformOp:orient = {_quaternion(turn.as_quat(scalar_first=True))}",
            '    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient"]',
            "}",
        ]
    return lines


def _mesh(motion: GraspMotion) -> list[str]:
    vertices, faces = motion.object_vertices, motion.object_faces
    return [
        'def Mesh "mesh"',
        "{",
        '    uniform token subdivisionScheme = "none"',
        f"    float3[] extent = [{_tuple(vertices.min(0))}, {_tuple(vertices.max(0))}]",
        f"    color3f[] primvars:displayColor = [{_tuple(_COLOURS[OBJECT])}]",
        f"    int[] faceVertexCounts = [{', '.join(['3'] * len(faces))}]",
        f"    int[] faceVertexIndices = [{', '.join(map(str, faces.ravel()))}]",
        f"    point3f[] points = [{', '.join(map(_tuple, vertices))}]",
        "}",
    ]


def read(path: pathlib.Path) -> list[Track]:
    """What Pixar's library works out at the time codes of a file."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    to_metres = UsdGeom.GetStageMetersPerUnit(stage)
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
    codes = np.arange(stage.GetStartTimeCode(), stage.GetEndTimeCode() + 1)
    named = {prim.GetAttribute(_NAME).Get(): prim for prim in stage.Traverse() if prim.HasAttribute(_NAME)}
    poses = {name: np.zeros((len(codes), 4, 4)) for name in named}
    for i, code in enumerate(codes):
        cache = UsdGeom.XformCache(float(code))
        for name, prim in named.items():
            poses[name][i] = np.array(cache.GetLocalToWorldTransform(prim)).T  # USD's vectors are rows
            poses[name][i, :3, 3] *= to_metres
    mesh = UsdGeom.Mesh(named[OBJECT].GetChild("mesh"))
    vertices = to_metres * np.array(mesh.GetPointsAttr().Get(), float)
    triangles = vertices[np.array(mesh.GetFaceVertexIndicesAttr().Get())].reshape(-1, 3, 3)
    return [Track(codes / stage.GetTimeCodesPerSecond(), poses, triangles)]
