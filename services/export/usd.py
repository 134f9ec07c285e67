"""USD as text (.usda) with time samples.

One Xform a link, nested as hand and arm are, the hand's with USD's own capsules as guides; object
and arm are meshes. The hand's surface is skinned: a skeleton of the links with an animation moves
it (UsdSkel).
"""

import json
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

from congrasp.common.episode.episode import Episode
from congrasp.common.hands.skin import MATERIALS, Skin
from congrasp.services.export.frames import (
    COLOURS,
    OBJECT,
    SKIN,
    Body,
    arm_meshes,
    bodies,
    capsules,
    facts,
    identifiers,
    object_mesh,
    skin_of_motion,
    unwrapped,
)
from congrasp.services.viz.kernels import GAMMA

_NAME = "congrasp:name"
_DOUBLE = UsdGeom.XformOp.PrecisionDouble


def write(path: pathlib.Path, motions: Sequence[Episode]) -> None:
    """Writes one motion."""
    (motion,) = motions
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(motion.time) - 1)
    stage.SetTimeCodesPerSecond(1 / motion.control_dt)
    stage.SetFramesPerSecond(1 / motion.control_dt)
    about = facts(
        motion, frame="z up (upAxis)", unit="m (metersPerUnit = 1)", quaternion="w, x, y, z"
    )
    stage.GetRootLayer().customLayerData = {"congrasp": json.dumps(about)}
    root = UsdGeom.Xform.Define(stage, "/grasp")
    stage.SetDefaultPrim(root.GetPrim())
    found, paths, arm = bodies(motion), [root.GetPath()], arm_meshes(motion)
    for i, (body, name) in enumerate(
        zip(found, identifiers([SKIN, *(body.name for body in found)])[1:], strict=True)
    ):
        xform = UsdGeom.Xform.Define(stage, paths[body.parent + 1].AppendChild(name))
        paths.append(xform.GetPath())
        xform.GetPrim().CreateAttribute(_NAME, Sdf.ValueTypeNames.String, True).Set(body.name)
        translate, orient = xform.AddTranslateOp(_DOUBLE), xform.AddOrientOp(_DOUBLE)
        if len(body.translation) == 1:
            translate.Set(Gf.Vec3d(*body.translation[0]))
        for t, turn in enumerate(body.quaternions(scalar_first=True)):
            orient.Set(Gf.Quatd(*turn), t)
            if len(body.translation) > 1:
                translate.Set(Gf.Vec3d(*body.translation[t]), t)
        if body.name == OBJECT:
            vertices, faces, paint = object_mesh(motion)
            colours = COLOURS[OBJECT] if paint is None else paint
            _add_mesh(stage, paths[-1].AppendChild("mesh"), vertices, faces, colours)
        _add_capsules(stage, paths[-1], motion, i)
        for number, part in enumerate(arm.get(body.name, ())):
            place = paths[-1].AppendChild(f"mesh_{number}")
            _add_mesh(stage, place, part.vertices, part.faces, part.colour, textured=False)
    links = found[: len(motion.link_names)]
    _add_skin(stage, root.GetPath().AppendChild(SKIN), skin_of_motion(motion), links)
    stage.Save()


def _add_capsules(stage: Usd.Stage, parent: Sdf.Path, motion: Episode, link: int) -> None:
    """Adds the link's capsules in its frame, which are its collision shapes; viewers hide
    guides.
    """
    for number, length, radius, middle, turn in capsules(motion, link):
        capsule = UsdGeom.Capsule.Define(stage, parent.AppendChild(f"capsule_{number}"))
        capsule.CreatePurposeAttr(UsdGeom.Tokens.guide)
        capsule.CreateAxisAttr(UsdGeom.Tokens.z)
        capsule.CreateHeightAttr(length)
        capsule.CreateRadiusAttr(radius)
        capsule.CreateExtentAttr(
            UsdGeom.Boundable.ComputeExtentFromPlugins(capsule, Usd.TimeCode.Default())
        )
        capsule.CreateDisplayColorAttr([COLOURS["link"]])
        capsule.AddTranslateOp(_DOUBLE).Set(Gf.Vec3d(*middle))
        capsule.AddOrientOp(_DOUBLE).Set(Gf.Quatd(*turn.as_quat(scalar_first=True)))


def _add_skin(stage: Usd.Stage, path: Sdf.Path, skin: Skin, links: Sequence[Body]) -> None:
    """Adds the hand's surface, a skeleton of its links, and their animation."""
    root = UsdSkel.Root.Define(stage, path)
    skeleton = UsdSkel.Skeleton.Define(stage, path.AppendChild("skeleton"))
    animation = UsdSkel.Animation.Define(stage, path.AppendChild("animation"))
    names: list[str] = []
    for link, name in zip(links, identifiers([link.name for link in links]), strict=True):
        names.append(f"{names[link.parent]}/{name}" if link.parent >= 0 else name)
    parents = np.array(
        [skin.origins[link.parent] if link.parent >= 0 else np.zeros(3) for link in links]
    )
    skeleton.CreateJointsAttr(names)
    skeleton.CreateBindTransformsAttr(
        [Gf.Matrix4d().SetTranslate(Gf.Vec3d(*o)) for o in skin.origins]
    )
    skeleton.CreateRestTransformsAttr(
        [Gf.Matrix4d().SetTranslate(Gf.Vec3d(*o)) for o in skin.origins - parents]
    )
    animation.CreateJointsAttr(names)
    animation.CreateScalesAttr([Gf.Vec3h(1, 1, 1)] * len(links))
    turns = np.stack([link.quaternions(scalar_first=True) for link in links], 1)
    places = np.stack([np.broadcast_to(link.translation, (len(turns), 3)) for link in links], 1)
    rotations, translations = animation.CreateRotationsAttr(), animation.CreateTranslationsAttr()
    for t, (turn, place) in enumerate(zip(turns, places, strict=True)):
        rotations.Set([Gf.Quatf(*map(float, q)) for q in turn], t)
        translations.Set(_vectors(place), t)
    colours = np.array([COLOURS[name] for name in MATERIALS])[skin.material]
    mesh = _add_mesh(stage, path.AppendChild("mesh"), skin.points, skin.faces, colours)
    mesh.CreateNormalsAttr(_vectors(skin.normals))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    influences, weights = skin.influences()
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateJointIndicesPrimvar(False, 4).Set(influences.ravel().tolist())
    binding.CreateJointWeightsPrimvar(False, 4).Set(weights.ravel().tolist())
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1.0))
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets(
        [animation.GetPath()]
    )
    UsdSkel.BindingAPI.Apply(root.GetPrim())


def _add_mesh(
    stage: Usd.Stage,
    path: Sdf.Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    colours: Any,
    *,
    textured: bool = True,
) -> UsdGeom.Mesh:
    """Adds triangles (F, 3), not subdivided, of one sRGB colour (3,) or with that of each vertex
    (V, 3).

    Displayed colours are linear.
    """
    mesh, points = UsdGeom.Mesh.Define(stage, path), _vectors(vertices)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreatePointsAttr(points)
    mesh.CreateFaceVertexCountsAttr([3] * len(faces))
    mesh.CreateFaceVertexIndicesAttr(faces.ravel().tolist())
    mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(points))
    colour = mesh.CreateDisplayColorAttr(_vectors(np.reshape(colours, (-1, 3)) ** GAMMA))
    if np.ndim(colours) > 1:
        UsdGeom.Primvar(colour).SetInterpolation(UsdGeom.Tokens.vertex)
    if textured:
        flat, kind = unwrapped(vertices, faces), Sdf.ValueTypeNames.TexCoord2fArray
        st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", kind, UsdGeom.Tokens.faceVarying)
        st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(flat.uv, np.float32)))
        st.SetIndices(Vt.IntArray(flat.faces.ravel().tolist()))
    return mesh


def _vectors(values: np.ndarray) -> Vt.Vec3fArray:
    """Vectors (n, 3) as USD's."""
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))
