"""Writes the binary inputs of the cases next to their descriptions: `python -m
tests.cases.make`.
"""

import itertools
import json
import pathlib
import re
import struct
import zipfile

import numpy as np
import trimesh

HERE = pathlib.Path(__file__).parent
BOX = trimesh.creation.box((0.04, 0.06, 0.1))


def stl(mesh: trimesh.Trimesh) -> bytes:
    """A binary STL file."""
    return trimesh.exchange.stl.export_stl(mesh)


def glb(tree: dict, binary: bytes) -> bytes:
    """A GLB file of this tree and binary chunk."""
    text = json.dumps(
        {"asset": {"version": "2.0"}, **tree, "buffers": [{"byteLength": len(binary)}]}
    ).encode()
    text, binary = text + b" " * (-len(text) % 4), binary + bytes(-len(binary) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary))
    return (
        head
        + struct.pack("<I", len(text))
        + b"JSON"
        + text
        + struct.pack("<I", len(binary))
        + b"BIN\0"
        + binary
    )


def scene(positions: np.ndarray, faces: np.ndarray, primitives=(), node=None, **extra) -> bytes:
    """A GLB file of one mesh; positions may be rows of integers with padding, of which three
    columns count.
    """
    points = np.ascontiguousarray(positions)
    corners = np.ascontiguousarray(faces, np.uint16)
    kinds = {"f": 5126, "H": 5123, "h": 5122, "B": 5121}
    kind = kinds[points.dtype.char]
    views = [
        {
            "buffer": 0,
            "byteOffset": 0,
            "byteLength": points.nbytes,
            "byteStride": points.strides[0],
        },
        {"buffer": 0, "byteOffset": points.nbytes, "byteLength": corners.nbytes},
    ]
    accessors = [
        {"bufferView": 0, "componentType": kind, "count": len(points), "type": "VEC3"},
        {"bufferView": 1, "componentType": 5123, "count": corners.size, "type": "SCALAR"},
    ]
    if kind != 5126:
        accessors[0]["normalized"] = True
    pieces = [{"attributes": {"POSITION": 0}, "indices": 1}, *primitives]
    tree = {
        "scenes": [{"nodes": [0]}],
        "scene": 0,
        "nodes": [{"mesh": 0, **(node or {})}],
        "meshes": [{"primitives": pieces}],
        "accessors": accessors,
        "bufferViews": views,
        **extra,
    }
    return glb(tree, points.tobytes() + corners.tobytes())


def quantised() -> bytes:
    """A box of 4 x 6 x 10 cm (10 cm along y) by normalised unsigned shorts with a stride of 8
    bytes.
    """
    unit = BOX.vertices / BOX.extents + 0.5
    rows = np.zeros((len(unit), 4), np.uint16)
    rows[:, :3] = np.round(65535 * unit[:, [0, 2, 1]])
    faces = np.asarray(BOX.faces)[:, ::-1]
    node = {"scale": [0.04, 0.1, 0.06]}
    required = {
        "extensionsRequired": ["KHR_mesh_quantization"],
        "extensionsUsed": ["KHR_mesh_quantization"],
    }
    return scene(rows, faces, node=node, **required)


def compressed(name: str) -> bytes:
    """A GLB file that needs an extension."""
    return scene(
        BOX.vertices.astype(np.float32), BOX.faces, extensionsRequired=[name], extensionsUsed=[name]
    )


def archive(*names: str) -> bytes:
    """A zip archive of empty files."""
    with zipfile.ZipFile(path := HERE / "archive.tmp", "w") as file:
        for name in names:
            file.writestr(zipfile.ZipInfo(name), "")
    data = path.read_bytes()
    path.unlink()
    return data


def ply(header: str, rows: np.ndarray) -> bytes:
    """A PLY file of points."""
    names = "".join(f"property float {name}\n" for name in header.split())
    header = f"ply\nformat ascii 1.0\nelement vertex {len(rows)}\n{names}end_header\n"
    lines = []
    for row in rows:
        lines.append(" ".join(f"{x:.3f}" for x in row))
    return (header + "\n".join(lines)).encode()


def collada(mesh: trimesh.Trimesh) -> bytes:
    """A COLLADA file in millimetres."""
    text = trimesh.exchange.dae.export_collada(mesh).decode()
    unit = '<unit name="millimeter" meter="0.001"/>'
    return (
        re.sub(r"<unit[^>]*/>", unit, text)
        if "<unit" in text
        else text.replace("</asset>", f"{unit}</asset>")
    ).encode()


def moved(mesh: trimesh.Trimesh, *offset: float) -> trimesh.Trimesh:
    """A copy elsewhere."""
    return mesh.copy().apply_translation(offset)


def main() -> None:
    """Writes all of them."""
    box = stl(BOX)
    float_box = BOX.vertices.astype(np.float32)
    long = trimesh.creation.box((0.12, 0.03, 0.03))
    both = trimesh.util.concatenate([BOX, BOX])
    other = trimesh.util.concatenate([BOX, moved(BOX, 0.04, 0, 0)])
    random = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(1, 0.03)
    mixed = ball.copy()
    pierced = ball.copy()
    spoilt, worse = (trimesh.creation.icosphere(2, 0.03) for _ in range(2))
    mixed.faces[::7] = np.asarray(mixed.faces)[::7, ::-1]
    pierced.update_faces(np.arange(len(ball.faces)) > 1)
    spoilt.vertices[3] = np.nan
    worse.vertices[:40] = np.nan
    far = ball.copy().apply_scale(0.5).apply_translation([0.2, 0, 0])
    inverted = BOX.copy()
    inverted.invert()
    files = {
        "sound/ball.stl": stl(ball),
        "unit_guess/part.stl": stl(BOX.copy().apply_scale(1000)),
        "unit_unclear/part.stl": stl(BOX.copy().apply_scale(100)),
        "inside_out/part.stl": stl(inverted),
        "mixed_winding/ball.stl": stl(trimesh.Trimesh(ball.vertices, mixed.faces, process=False)),
        "holes/ball.stl": stl(pierced),
        "apart/two.stl": stl(trimesh.util.concatenate([far, ball])),
        "not_finite/ball.ply": spoilt.export(file_type="ply"),
        "not_finite_many/ball.ply": worse.export(file_type="ply"),
        "parts/tool/graspable.stl": stl(moved(trimesh.creation.box((0.02, 0.02, 0.1)), 0, 0, 0.05)),
        "parts/tool/non_graspable.stl": stl(
            moved(trimesh.creation.box((0.06, 0.02, 0.03)), 0, 0, 0.115)
        ),
        "parts_tiny/ball/top.stl": box,
        "parts_tiny/ball/bottom.stl": stl(
            moved(trimesh.creation.box((0.01,) * 3), *(0.346408,) * 3)
        ),
        "stl_count/part.stl": box[:80] + struct.pack("<I", 5) + box[84:],
        "stl_tail/part.stl": box + b"colour table",
        "stl_cut/part.stl": box[:-30],
        "stl_solid/part.stl": b"solid part of facet".ljust(80) + box[80:],
        "glb_quantised/part.glb": quantised(),
        "gltf_embedded/part.gltf": trimesh.exchange.gltf.export_gltf(
            trimesh.Scene(BOX), embed_buffers=True
        )["model.gltf"],
        "glb_draco/part.glb": compressed("KHR_draco_mesh_compression"),
        "glb_meshopt/part.glb": compressed("EXT_meshopt_compression"),
        "glb_unknown/part.glb": compressed("ACME_folded_surfaces"),
        "glb_upright/tall.glb": scene(float_box[:, [0, 2, 1]], np.asarray(BOX.faces)[:, ::-1]),
        "glb_lines/part.glb": scene(
            float_box, BOX.faces, ({"attributes": {"POSITION": 0}, "mode": 1}, {"attributes": {}})
        ),
        "doubled/part.stl": stl(both),
        "two_sided/part.stl": stl(
            trimesh.Trimesh(BOX.vertices, np.concatenate([BOX.faces, BOX.faces[:, ::-1]]))
        ),
        "overlapping/cross.stl": stl(
            trimesh.util.concatenate([long, trimesh.creation.box((0.03, 0.12, 0.03))])
        ),
        "touching/pair.stl": stl(other),
        "points_ply/scan.ply": ply("x y z", random.random((9, 3))),
        "points_splat/scene.ply": ply("x y z f_dc_0 f_dc_1 f_dc_2", random.random((9, 6))),
        "archive_3mf/part.3mf": archive("3D/3dmodel.model", "[Content_Types].xml"),
        "archive_usdz/part.usdz": archive("part.usdc"),
        "archive_zip/part.stl": archive("models/mug.obj", "licence.txt"),
        **{
            f"{case}/{folder}/mug.stl": box
            for case, folder in itertools.product(("sets_of_one_name", "equal_names"), "ab")
        },
        "names/碗.stl": box,
        "names/कटोरी.stl": box,
        "names/mug.stl": box,
        "names/mug.obj": BOX.export(file_type="obj").encode(),
        "hand_collada/link.dae": collada(trimesh.creation.box((20, 14, 50))),
        "hand_mm/link.stl": stl(trimesh.creation.box((20, 14, 50))),
        "hand_called_xml/parts/link.stl": stl(trimesh.creation.box((0.02, 0.014, 0.05))),
        "hand_attached/a/palm.stl": stl(trimesh.creation.box((0.06, 0.1, 0.03))),
        "hand_attached/b/tip.stl": stl(
            moved(trimesh.creation.box((0.02, 0.014, 0.04)), 0, 0, 0.02)
        ),
    }
    for name, data in files.items():
        (HERE / name).parent.mkdir(parents=True, exist_ok=True)
        (HERE / name).write_bytes(data)


if __name__ == "__main__":
    main()
