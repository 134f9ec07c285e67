"""Masses of objects by density or material, and conditions for hollow objects."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import trimesh

from congrasp.common.objects.shapes import mass_properties, tessellate
from congrasp.common.objects.spec import GraspObject, Piece
from congrasp.services.assets.objects.interior import Enclosed, enclosed
from congrasp.services.assets.objects.materials import Material, materials_of
from congrasp.services.assets.objects.repair import encloses

DENSITY_LIMITS = (500.0, 2500.0)
"""Limits of the density of an object of unknown material, kg/m^3."""
MASS_PER_SURFACE = 4.0
"""Mass of an object of unknown material per surface, kg/m^2: 2 mm of wall at 2,000 kg/m^3."""
MAX_GUESSED_MASS_KG = 0.5
"""Largest mass of an object of unknown material, kg."""
_MAX_SHEET_THICKNESS_M = 5e-4
"""Mean thickness below which an open mesh is a sheet without thickness, m."""


class Weight(NamedTuple):
    """Mass properties of a body."""

    mass: float
    """kg."""
    center: np.ndarray
    """(3,) m, centre of mass."""
    inertia: np.ndarray
    """(3, 3) kg.m^2 about the centre of mass."""


def mean_thickness(mesh: trimesh.Trimesh) -> float:
    """Returns 2 V / A in m: the thickness of a wall, half the diameter of a long rod.

    An open mesh encloses the volume of the cones from its middle to its triangles.
    """
    corners = mesh.triangles - mesh.triangles.mean((0, 1))
    volume = abs(float(np.linalg.det(corners).sum()) / 6)
    return 2 * volume / float(mesh.area)


def hollow(mesh: trimesh.Trimesh, material: Material) -> bool:
    """Returns True for a body whose mass is that of its wall.

    It is thicker than objects of its material are, or a sheet.
    """
    thickness = mean_thickness(mesh)
    if thickness > material.thickest_solid:
        return True
    return not encloses(mesh) and thickness < _MAX_SHEET_THICKNESS_M


def weigh(bodies: Sequence[trimesh.Trimesh], materials: Sequence[Material]) -> Weight:
    """Returns mass properties of several bodies together, each solid or `hollow`.

    Args:
      bodies: surfaces, m, in one frame. A thin shell is solid: its walls have two sides, which
        enclose the material.
      materials: material of each body.
    """
    weights = [_weigh(body, material) for body, material in zip(bodies, materials, strict=True)]
    mass = sum(weight.mass for weight in weights)
    center = sum((weight.mass * weight.center for weight in weights), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for weight in weights:
        offset = weight.center - center
        parallel_axis = offset @ offset * np.eye(3) - np.outer(offset, offset)
        inertia += weight.inertia + weight.mass * parallel_axis
    return Weight(mass, center, inertia)


def _weigh(mesh: trimesh.Trimesh, material: Material) -> Weight:
    """Mass properties of one body; those of an open one are distributed over its surface."""
    is_closed = encloses(mesh)
    if hollow(mesh, material):
        area = float(mesh.area)
        if is_closed:
            area = enclosed(np.asarray(mesh.triangles)).area
        return _on_surface(mesh, material.wall * material.density * area)
    if not is_closed:
        volume = mean_thickness(mesh) * float(mesh.area) / 2
        return _on_surface(mesh, volume * material.density)
    solid = enclosed(np.asarray(mesh.triangles))
    return Weight(material.density * solid.volume, solid.center, material.density * solid.inertia)


def _on_surface(mesh: trimesh.Trimesh, mass: float) -> Weight:
    """Mass properties of a mass distributed evenly over a surface."""
    share = mesh.area_faces / mesh.area
    center = share @ mesh.triangles.mean(1)
    corners = mesh.triangles - center
    total = corners.sum(1)
    # The integral of x x^T over a triangle is A / 12 (the sum of v v^T over its corners + s s^T of
    # their sum).
    second_moment = np.einsum("f,fki,fkj->ij", share, corners, corners)
    second_moment = second_moment + np.einsum("f,fi,fj->ij", share, total, total)
    second_moment *= mass / 12
    inertia = np.trace(second_moment) * np.eye(3) - second_moment
    return Weight(mass, center, inertia)


def weigh_parts(
    whole: Sequence[trimesh.Trimesh],
    parts: Sequence[trimesh.Trimesh],
    material: str,
    names: Sequence[str],
) -> Weight:
    """Returns mass properties of an object by its material, or by that of each part.

    Args:
      whole: its surface, m.
      parts: that of each part.
      material: see `materials_of`.
      names: names of the parts.
    """
    if "=" in material:
        return weigh(parts, materials_of(material, names))
    return weigh(whole, materials_of(material, [""] * len(whole)))


def weigh_evenly(
    mesh: trimesh.Trimesh,
    solid: Enclosed | None,
    hulls: Sequence[np.ndarray],
    density: float | None,
) -> Weight:
    """Returns mass properties of an evenly dense body.

    Args:
      mesh: its surface, m.
      solid: measures of what the surface encloses; None for an open one.
      hulls: vertices (V, 3) of the convex solids that replace an open surface, m.
      density: kg/m^3; None guesses the mass.
    """
    if solid:
        volume = solid.volume
        area = solid.area
        center = solid.center
        inertia = solid.inertia
    else:
        pieces = tuple(Piece("mesh", (0, 0, 0), vertices=hull) for hull in hulls)
        volume, center, inertia = mass_properties(pieces, np.ones(len(pieces)))
        area = float(mesh.area)
    mass = guessed_mass(volume, area) if density is None else density * volume
    return Weight(mass, center, inertia * mass / volume)


def guessed_mass(volume: float, area: float) -> float:
    """Returns the mass in kg of an object of unknown material.

    Args:
      volume: m^3.
      area: of its surface, m^2.
    """
    lowest, highest = DENSITY_LIMITS
    mass = max(MASS_PER_SURFACE * area, lowest * volume)
    return min(mass, highest * volume, MAX_GUESSED_MASS_KG)


def with_mass(obj: GraspObject, mass: float | None, material: str) -> GraspObject:
    """Returns the object with another mass, and an inertia in proportion.

    Args:
      obj: an object of convex pieces, each of which is solid or `hollow`.
      mass: kg.
      material: see `materials_of`; determines the mass if `mass` is None. Without both the object
        is unchanged.
    """
    if mass is None and material:
        part_materials = materials_of(material, obj.part_names)
        bodies = [trimesh.Trimesh(*tessellate(piece), process=False) for piece in obj.pieces]
        mass = weigh(bodies, [part_materials[piece.part] for piece in obj.pieces]).mass
    if mass is None:
        return obj
    return dataclasses.replace(obj, mass=mass, inertia=obj.inertia * mass / obj.mass)
