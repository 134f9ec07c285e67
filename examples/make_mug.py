"""Makes the mug of the README and the tutorials: `mug.obj`, and its handle alone, `handle.obj`.

    python examples/make_mug.py

Metres; the mug stands on z = 0, and its handle points along x.
"""

import pathlib

import numpy as np
import trimesh

RADIUS, HEIGHT, WALL = 0.040, 0.095, 0.004
HANDLE_RADIUS, REACH, HALF = 0.0055, 0.032, 0.030
"""Of the handle, m: radius of its tube, distance of its centre line from the wall, and half of its
height.
"""
BAND_WIDTH = 0.016
SECTIONS, SIDES, STEPS = 48, 12, 32
GLAZE, BAND, INSIDE = (38, 84, 124), (239, 160, 75), (244, 238, 226)
"""Colours outside, around the rim, and inside."""


def body() -> trimesh.Trimesh:
    """A cup with a rounded foot and lip, closed in itself."""
    inner, floor, foot = RADIUS - WALL, 0.005, 0.006
    quarter, lip = np.linspace(0, np.pi / 2, 6), np.linspace(0, np.pi, 7)
    profile = np.vstack(
        [
            (0, 0),
            _arc(RADIUS - foot, foot, foot, quarter - np.pi / 2),
            (RADIUS, 0.5 * HEIGHT),
            (RADIUS, HEIGHT - BAND_WIDTH - 0.004),
            (RADIUS, HEIGHT - BAND_WIDTH),
            _arc(RADIUS - WALL / 2, HEIGHT - WALL / 2, WALL / 2, lip),
            (inner, floor + foot),
            _arc(inner - foot, floor + foot, foot, -quarter),
            (0, floor),
        ]
    )
    mesh = trimesh.creation.revolve(profile, sections=SECTIONS)
    x, y, z = mesh.vertices.T
    inside = (np.hypot(x, y) < RADIUS - WALL / 2 - 1e-6) & (z > 0.0049)
    band = ~inside & (z > HEIGHT - BAND_WIDTH - 1e-6)
    colours = np.where(inside[:, None], INSIDE, np.where(band[:, None], BAND, GLAZE))
    mesh.visual.vertex_colors = colours.astype(np.uint8)
    return mesh


def _arc(x: float, z: float, radius: float, angles: np.ndarray) -> np.ndarray:
    """(n, 2) points of a circle's arc."""
    return np.stack([x + radius * np.cos(angles), z + radius * np.sin(angles)], -1)


def handle() -> trimesh.Trimesh:
    """A tube along half an ellipse, whose ends are inside the cup's wall."""
    turn = np.linspace(-np.pi / 2, np.pi / 2, STEPS)
    path = np.stack(
        [RADIUS - WALL / 2 + REACH * np.cos(turn), 0 * turn, HEIGHT / 2 + HALF * np.sin(turn)], -1
    )
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    side = np.array([0.0, 1.0, 0.0])
    angle = np.linspace(0, 2 * np.pi, SIDES, endpoint=False)
    ring = (
        np.cross(along, side)[:, None] * np.cos(angle)[:, None]
        + 1.3 * side * np.sin(angle)[:, None]
    )
    tube = (path[:, None] + HANDLE_RADIUS * ring).reshape(-1, 3)
    i, k = np.meshgrid(np.arange(STEPS - 1) * SIDES, np.arange(SIDES), indexing="ij")
    a, b = (i + k).ravel(), (i + (k + 1) % SIDES).ravel()
    rim, far, first = np.arange(SIDES), (STEPS - 1) * SIDES, STEPS * SIDES
    turned = np.roll(rim, -1)
    faces = [
        *(np.stack([a, b, a + SIDES], -1), np.stack([b, b + SIDES, a + SIDES], -1)),
        *(
            np.stack([turned, rim, 0 * rim + first], -1),
            np.stack([rim + far, turned + far, 0 * rim + first + 1], -1),
        ),
    ]
    mesh = trimesh.Trimesh(np.vstack([tube, path[[0, -1]]]), np.vstack(faces), process=False)
    mesh.fix_normals()
    mesh.visual.vertex_colors = np.tile(np.uint8(GLAZE), (len(mesh.vertices), 1))
    return mesh


def main(folder: pathlib.Path = pathlib.Path(__file__).parent) -> None:
    """Writes both files."""
    for name, mesh in (("mug", trimesh.util.concatenate([body(), handle()])), ("handle", handle())):
        text = trimesh.exchange.obj.export_obj(
            mesh, include_normals=False, header="Made by examples/make_mug.py", digits=5
        )
        (folder / f"{name}.obj").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
