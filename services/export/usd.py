"""USD as text (.usda) with time samples.

Each link is an Xform, nested as in hand and arm. The hand's links have USD's capsules as guides;
object and arm have meshes. The hand's surface is skinned: a skeleton of the links with an animation
moves it (UsdSkel).
"""

import json
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

from congrasp.common.episode.episode import Episode
from congrasp.common.hands.skin import MATERIALS, Skin
from congrasp.services.export.facts import facts
from congrasp.services.export.frames import OBJECT, SKIN, Body, bodies, capsules, identifiers
from congrasp.services.export.surfaces import COLOURS, arm_meshes, object_mesh, skin_of_motion
from congrasp.services.export.texture_coordinates import Unwrapped, unwrapped
from congrasp.services.viz.kernels import GAMMA

_NAME = "congrasp:name"
"""Attribute with the original name of a body, which need not be an identifier."""
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
    hand_bodies = _add_bodies(stage, root.GetPath(), motion)[: len(motion.link_names)]
    skin_path = root.GetPath().AppendChild(SKIN)
    _add_skin(stage, skin_path, skin_of_motion(motion), hand_bodies)
    stage.Save()


def _add_bodies(stage: Usd.Stage, root: Sdf.Path, motion: Episode) -> list[Body]:
    """Adds an animated transform for each body, with its meshes and capsules; returns the
    bodies.
    """
    motion_bodies = bodies(motion)
    names = identifiers([SKIN, *(body.name for body in motion_bodies)])[1:]
    meshes_of_link = arm_meshes(motion)
    paths = [root]
    for i, (body, name) in enumerate(zip(motion_bodies, names, strict=True)):
        path = paths[body.parent + 1].AppendChild(name)  # the first path is the root's
        paths.append(path)
        _add_transform(stage, path, body)
        if body.name == OBJECT:
            _add_object(stage, path.AppendChild("mesh"), motion)
        _add_capsules(stage, path, motion, i)
        for number, mesh in enumerate(meshes_of_link.get(body.name, ())):
            mesh_path = path.AppendChild(f"mesh_{number}")
            _add_mesh(stage, mesh_path, mesh.vertices, mesh.faces, mesh.colour, textured=False)
    return motion_bodies


def _add_transform(stage: Usd.Stage, path: Sdf.Path, body: Body) -> None:
    """Adds a body's pose in its parent's frame, with time samples."""
    xform = UsdGeom.Xform.Define(stage, path)
    xform.GetPrim().CreateAttribute(_NAME, Sdf.ValueTypeNames.String, True).Set(body.name)
    translate = xform.AddTranslateOp(_DOUBLE)
    orient = xform.AddOrientOp(_DOUBLE)
    moves = len(body.translation) > 1
    if not moves:
        translate.Set(Gf.Vec3d(*body.translation[0]))
    for t, quaternion in enumerate(body.quaternions(scalar_first=True)):
        orient.Set(Gf.Quatd(*quaternion), t)
        if moves:
            translate.Set(Gf.Vec3d(*body.translation[t]), t)


def _add_object(stage: Usd.Stage, path: Sdf.Path, motion: Episode) -> None:
    """Adds the object's mesh, in one colour or in those of its points."""
    vertices, faces, point_colours = object_mesh(motion)
    colours = COLOURS[OBJECT] if point_colours is None else point_colours
    _add_mesh(stage, path, vertices, faces, colours)


def _add_capsules(stage: Usd.Stage, parent: Sdf.Path, motion: Episode, link: int) -> None:
    """Adds the link's capsules in its frame, which are its collision shapes; viewers hide
    guides.
    """
    for shape in capsules(motion, link):
        capsule = UsdGeom.Capsule.Define(stage, parent.AppendChild(f"capsule_{shape.number}"))
        capsule.CreatePurposeAttr(UsdGeom.Tokens.guide)
        capsule.CreateAxisAttr(UsdGeom.Tokens.z)
        capsule.CreateHeightAttr(shape.length)
        capsule.CreateRadiusAttr(shape.radius)
        capsule.CreateExtentAttr(
            UsdGeom.Boundable.ComputeExtentFromPlugins(capsule, Usd.TimeCode.Default())
        )
        capsule.CreateDisplayColorAttr([COLOURS["link"]])
        capsule.AddTranslateOp(_DOUBLE).Set(Gf.Vec3d(*shape.middle))
        quaternion = shape.turn.as_quat(scalar_first=True)
        capsule.AddOrientOp(_DOUBLE).Set(Gf.Quatd(*quaternion))


def _add_skin(stage: Usd.Stage, path: Sdf.Path, skin: Skin, links: Sequence[Body]) -> None:
    """Adds the hand's surface, a skeleton of its links, and their animation."""
    root = UsdSkel.Root.Define(stage, path)
    skeleton = UsdSkel.Skeleton.Define(stage, path.AppendChild("skeleton"))
    animation = UsdSkel.Animation.Define(stage, path.AppendChild("animation"))
    _describe_skeleton(skeleton, skin, links)
    _describe_animation(animation, links)
    material_colours = np.array([COLOURS[name] for name in MATERIALS])
    colours = material_colours[skin.material]
    mesh = _add_mesh(stage, path.AppendChild("mesh"), skin.points, skin.faces, colours)
    mesh.CreateNormalsAttr(_vectors(skin.normals))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    influences, weights = skin.influences()
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateJointIndicesPrimvar(False, 4).Set(influences.ravel().tolist())
    binding.CreateJointWeightsPrimvar(False, 4).Set(weights.ravel().tolist())
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1.0))
    animated = UsdSkel.BindingAPI.Apply(skeleton.GetPrim())
    animated.CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    UsdSkel.BindingAPI.Apply(root.GetPrim())


def _describe_skeleton(skeleton: UsdSkel.Skeleton, skin: Skin, links: Sequence[Body]) -> None:
    """Sets the joints of a skeleton and their poses at rest, with every joint of the hand at
    zero.
    """
    parent_origins = np.zeros_like(skin.origins)
    for i, link in enumerate(links):
        if link.parent >= 0:
            parent_origins[i] = skin.origins[link.parent]
    skeleton.CreateJointsAttr(_joint_paths(links))
    skeleton.CreateBindTransformsAttr(_translations(skin.origins))
    skeleton.CreateRestTransformsAttr(_translations(skin.origins - parent_origins))


def _describe_animation(animation: UsdSkel.Animation, links: Sequence[Body]) -> None:
    """Sets the joints of an animation and their poses in their parents' frames."""
    animation.CreateJointsAttr(_joint_paths(links))
    animation.CreateScalesAttr([Gf.Vec3h(1, 1, 1)] * len(links))
    quaternions = np.stack([link.quaternions(scalar_first=True) for link in links], 1)
    shape = (len(quaternions), 3)
    positions = np.stack([np.broadcast_to(link.translation, shape) for link in links], 1)
    rotations = animation.CreateRotationsAttr()
    translations = animation.CreateTranslationsAttr()
    for t, positions_at_t in enumerate(positions):
        rotations.Set([Gf.Quatf(*row) for row in quaternions[t].tolist()], t)
        translations.Set(_vectors(positions_at_t), t)


def _joint_paths(links: Sequence[Body]) -> list[str]:
    """Paths of the links in a skeleton, such as `palm/index_proximal`."""
    names = identifiers([link.name for link in links])
    paths: list[str] = []
    for link, name in zip(links, names, strict=True):
        path = name
        if link.parent >= 0:
            path = f"{paths[link.parent]}/{name}"
        paths.append(path)
    return paths


def _translations(origins: np.ndarray) -> list[Gf.Matrix4d]:
    """Matrices of translations (n, 3)."""
    return [Gf.Matrix4d().SetTranslate(Gf.Vec3d(*origin)) for origin in origins]


def _add_mesh(
    stage: Usd.Stage,
    path: Sdf.Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    colours: Any,
    *,
    textured: bool = True,
) -> UsdGeom.Mesh:
    """Adds triangles (F, 3) between vertices (V, 3), m, which readers must not subdivide.

    Args:
      stage: the file.
      path: path of the new mesh.
      vertices: the vertices.
      faces: the triangles.
      colours: sRGB from 0 to 1, (3,) of the mesh or (V, 3) of its vertices; USD stores linear
        colours.
      textured: also adds texture coordinates.
    """
    mesh = UsdGeom.Mesh.Define(stage, path)
    points = _vectors(vertices)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreatePointsAttr(points)
    mesh.CreateFaceVertexCountsAttr([3] * len(faces))
    mesh.CreateFaceVertexIndicesAttr(faces.ravel().tolist())
    mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(points))
    linear = np.reshape(colours, (-1, 3)) ** GAMMA
    colour = mesh.CreateDisplayColorAttr(_vectors(linear))
    if np.ndim(colours) > 1:
        UsdGeom.Primvar(colour).SetInterpolation(UsdGeom.Tokens.vertex)
    if textured:
        _add_texture_coordinates(mesh, unwrapped(vertices, faces))
    return mesh


def _add_texture_coordinates(mesh: UsdGeom.Mesh, flat: Unwrapped) -> None:
    """Adds texture coordinates to each corner of a mesh's faces."""
    kind = Sdf.ValueTypeNames.TexCoord2fArray
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", kind, UsdGeom.Tokens.faceVarying)
    st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(flat.uv, np.float32)))
    st.SetIndices(Vt.IntArray(flat.faces.ravel().tolist()))


def _vectors(values: np.ndarray) -> Vt.Vec3fArray:
    """Converts vectors (n, 3) to an array of USD."""
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))
