"""Mesh files: their kind by content, limits before they are read, and what the readers of trimesh
leave to the caller.

STL is read here, by its content and size. Before trimesh reads them, an OBJ's relative indices
become absolute, a PLY's polygons triangles (`ply`), and a GLB's integers the numbers that they
stand for (`gltf`). Textures, materials and colours of the files are sampled at points of their
surface.
"""

import array
import io
import itertools
import pathlib
import re
import tomllib
import zipfile
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import trimesh
from trimesh.visual.color import uv_to_interpolated_color

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_file
from congrasp.common.objects.spec import COLOUR_POINTS, Colours
from congrasp.services.assets.objects import repair
from congrasp.services.assets.objects.gltf import MAX_FACES, packed, plain_glb
from congrasp.services.assets.objects.options import Up
from congrasp.services.assets.objects.ply import plain_ply
from congrasp.services.assets.objects.polygons import alike, cut_dented

SUFFIXES = (".stl", ".obj", ".ply", ".glb")
CONVERT = "Convert it to STL, OBJ, PLY or GLB."
MAX_BYTES = 512 << 20
"""Bytes of a mesh file."""
CHECK = f"Check the path and its permissions, or export it with less than {MAX_BYTES >> 20} MB."
_AGAIN = "Export it again, or convert it."
_UNPACK = "Unpack it and name the mesh inside."
_SURFACE = (
    "Make a surface of it (in MeshLab: Filters, Remeshing, Screened Poisson) and export that."
)
_FOREIGN = pathlib.Path(__file__).with_name("foreign.toml")
_STL_HEADER, _STL_TRIANGLE = 84, 50  # bytes
_STL_ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
_VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)
_INDENT = re.compile(rb"(?m)^[ \t]+")
_RELATIVE = re.compile(rb"(?m)^[ \t]*f[^\n]*[ \t/]-\d")
_ZERO = re.compile(rb"(?m)^[ \t]*f[^\n]*[ \t]0+(?=[/\s]|$)")
_COMMA = re.compile(rb"(?mi)^[ \t]*(v[ \t]+|vertex[ \t]+)?[-+]?\d+,\d+(?:e[-+]?\d+)?[ \t]")
_POINTS = re.compile(rb"(?m)^[ \t]*v[ \t]+([^\n#]*)")
_POLYGON = re.compile(rb"(?m)^[ \t]*f((?:[ \t]+\d[\d/]*){4,})[ \t\r]*$")
_REMARK = re.compile(rb"(?m)^([ \t]*f[^\n#]*)#[^\n]*")
_FACE = re.compile(rb"(?m)^[ \t]*f[ \t][^\n#]*")
_INDEX, _LINE = re.compile(rb"[ \t](\d{1,18})"), re.compile(rb"(?m)^l +\S+ +([^\n#]*)")
_NO_POINT = "a face refers to a point that is not in the file"
_START = 4096
_MARK = b"\xef\xbb\xbf"  # of UTF-8
_FARTHEST = 1e12  # largest coordinate in the file's unit, so that squares and products are finite
_COARSE = 0.01  # of a mesh's size: largest rounding of its coordinates in single precision
_UNSAID = (102, 102, 102)  # default colour of a material in trimesh


@np.errstate(all="ignore")  # of numbers that are refused, or far out
def read_mesh(
    path: pathlib.Path, notes: list[str] | None = None, up: Up = "auto"
) -> trimesh.Trimesh:
    """Reads one mesh, in the file's own unit, with merged vertices and each proper triangle once.

    Args:
      path: the file; its content determines the kind, not its name.
      notes: repairs are appended.
      up: axis that points up in the file (`up_of`); a y axis becomes z.

    Raises:
      CongraspError: not a mesh, empty, or not finite.
    """
    said = [] if notes is None else notes
    kind, data = _content(path)
    if f".{kind}" != path.suffix.lower():
        said.append(f"its content is {kind.upper()}, whatever its name says, and was read as that")
    loaded = _geometry(path, kind, data, _AGAIN, said, skip_materials=True)
    axis, mesh = (
        up_of(loaded, up),
        loaded.to_mesh() if isinstance(loaded, trimesh.Scene) else loaded,
    )
    if not len(getattr(mesh, "faces", ())):
        raise CongraspError(
            *_without_triangles(path, kind, data, len(getattr(mesh, "vertices", ())))
        )
    if mesh.vertices.shape[1:] != (3,) or mesh.faces.shape[1:] != (3,):
        raise CongraspError(f"{path} has points that are not of three numbers.", _AGAIN)
    check_triangles(path, mesh)
    finite = repair.without_gaps(np.asarray(mesh.vertices), np.asarray(mesh.faces), said)
    if finite is None:
        bad = int((~np.isfinite(mesh.vertices)).any(-1).sum())
        raise CongraspError(
            f"{path} has {bad} vertices that are not finite numbers.", "Repair or export it again."
        )
    if (farthest := np.abs(finite[0]).max(initial=0.0)) > _FARTHEST:
        raise CongraspError(
            f"{path} has a coordinate of {farthest:.3g}.",
            f"{_FARTHEST:g} is the most, in any unit.",
        )
    step, size = float(np.spacing(np.float32(farthest))), np.ptp(finite[0], axis=0).max(initial=0.0)
    if 0 < _COARSE * size < step and (finite[0].astype(np.float32) == finite[0]).all():
        raise CongraspError(
            f"{path} is so far from its origin that its coordinates are rounded to {step:.2g}.",
            "Move it to the origin in the program that wrote it, and export it again.",
        )
    vertices, faces = repair.reduced(*finite, said)
    mesh = repair.merged(upright(vertices, axis), faces, said)
    if len(mesh.faces) < 4:
        raise CongraspError(
            f"{path} has no volume: only {len(mesh.faces)} proper triangles.",
            "Export a closed mesh.",
        )
    mesh.metadata["kind"] = loaded.metadata["kind"]
    return mesh


def check_triangles(path: pathlib.Path, mesh: trimesh.Trimesh) -> None:
    """Raises a CongraspError if a triangle of a mesh refers to a vertex that it lacks, or there are
    too many.
    """
    if (
        len(mesh.faces) > MAX_FACES
        or mesh.faces.min() < 0
        or mesh.faces.max() >= len(mesh.vertices)
    ):
        raise CongraspError(f"{path} has triangles without vertices, or too many.", _AGAIN)


def up_of(geometry: Any, up: Up = "auto") -> Literal["y", "z"]:
    """The axis that points up in the file of a geometry: y in GLB by the standard of glTF, z in
    others, or `up`.
    """
    return up if up != "auto" else "y" if geometry.metadata["kind"] == "glb" else "z"


def upright(points: np.ndarray, up: Literal["y", "z"]) -> np.ndarray:
    """Points or vectors (..., 3) of a file whose `up` axis points up, turned so that z does."""
    return points if up == "z" else np.asarray(points)[..., [0, 2, 1]] * [1, -1, 1]


def load_geometry(
    path: pathlib.Path, remedy: str, *, notes: list[str] | None = None, **options: Any
) -> Any:
    """Loads a file with trimesh, as a mesh, a point cloud or a scene, in the file's axes and unit.

    Args:
      path: the file; its content determines the kind, not its name.
      remedy: remedy for the error message.
      notes: what was left out of it, or is missing, is appended.
      **options: of `trimesh.load`.

    Returns:
      The geometry; its `metadata["kind"]` is stl, obj, ply or glb, also of a glTF file.

    Raises:
      CongraspError: it cannot be read; the line ends with the remedy.
    """
    return _geometry(path, *_content(path), remedy, [] if notes is None else notes, **options)


def _geometry(
    path: pathlib.Path, kind: str, data: bytes, remedy: str, notes: list[str], **options: Any
) -> Any:
    """The geometry of a file with this content; see `load_geometry`."""
    try:
        if b"\0" not in data[:_START] and any(
            kind == "ply" or row[1] for row in _COMMA.finditer(data)
        ):
            raise ValueError("its numbers have commas for decimal points")
        if kind == "stl":
            found: Any = _stl(data, notes)
        else:
            kind, data = ("glb", packed(data)) if kind == "gltf" else (kind, data)
            prepared = {"ply": plain_ply, "glb": plain_glb, "obj": _plain_obj}[kind](data, notes)
            files = _Files(path, notes)
            found = trimesh.load(
                io.BytesIO(prepared), file_type=kind, resolver=files, process=False, **options
            )
    except CongraspError as error:
        raise CongraspError(f"{path} {error}") from None
    except Exception as error:  # the readers raise whatever they stumble over
        reason = (str(error) or type(error).__name__).splitlines()[0][:200].rstrip(" .!")
        if kind == "obj" and isinstance(error, IndexError):
            text = data.replace(b"\r", b"\n")
            points = len(_POINTS.findall(text))
            if any(
                int(index) > points
                for face in _FACE.findall(text)
                for index in _INDEX.findall(face)
            ):
                reason = _NO_POINT
        raise CongraspError(f"{path} cannot be read as {kind.upper()}: {reason}.", remedy) from None
    found.metadata["kind"] = kind
    return found


class _Files(trimesh.resolvers.FilePathResolver):
    """Finds materials and pictures that a mesh file names, also by paths of Windows; notes those
    that are missing.
    """

    def __init__(self, path: pathlib.Path, notes: list[str]):
        super().__init__(str(path))
        self._folder, self._notes = path.parent, notes

    def get(self, name: str) -> bytes:
        """Content of a file next to the mesh."""
        plain = str(name).strip().replace("\\", "/")
        for file in (self._folder / plain, self._folder / pathlib.PurePosixPath(plain).name):
            if file.is_file():
                return read_file(file, MAX_BYTES)
        note = f"the file '{name}' that it names is missing"
        if note not in self._notes:
            self._notes.append(note)
        raise FileNotFoundError(note)


def _content(path: pathlib.Path) -> tuple[str, bytes]:
    """The kind of a mesh file by its content, or by its name if the content is ambiguous; and the
    content.

    Raises:
      CongraspError: it cannot be read, is empty, or is not a mesh; the remedy describes how to get
        one.
    """
    data = read_file(path, MAX_BYTES, CHECK)
    if not data:
        raise CongraspError(f"{path} is empty (0 bytes).", "Export or download it again.")
    start, suffix = data[:_START], path.suffix.lower()
    if kind := _supported(start, len(data)):
        return kind, data
    text = start.removeprefix(_MARK).lstrip()
    if text.startswith(b"{") and b'"asset"' in data:
        return "gltf", data
    if foreign := _foreign(text, data):
        raise CongraspError(f"{path} is {foreign[0]}.", foreign[1])
    if suffix not in SUFFIXES:
        if _rows_of_numbers(text):
            raise CongraspError(f"{path} holds rows of numbers: a point cloud.", _SURFACE)
        raise CongraspError(f"{path} is not an STL, OBJ, PLY or GLB file.", CONVERT)
    return suffix[1:], data


def _supported(start: bytes, size: int) -> str:
    """The kind of a mesh file with this beginning and size in bytes; empty if it is none."""
    if start.startswith(b"glTF"):
        return "glb"
    if start.startswith((b"ply\n", b"ply\r", b"ply ")):
        return "ply"
    if _is_exact(start, size) or _is_text_stl(start) or _holds_records(start):
        return "stl"
    lines = [line.split() for line in start.splitlines()]
    points = sum(len(words) >= 4 and words[0] == b"v" for words in lines)
    return "obj" if points >= 3 and not start.startswith(b"PK\3\4") else ""


def _foreign(text: bytes, data: bytes) -> tuple[str, str] | None:
    """Kind of a file that is no mesh, by its beginning and its content, and the remedy; None if it
    is unknown.
    """
    inside, zipped, names = text.lower(), text.startswith(b"PK\3\4"), list[str]()
    if zipped:
        try:
            names = zipfile.ZipFile(io.BytesIO(data)).namelist()
        except (OSError, zipfile.BadZipFile):
            return "a zip archive that is damaged", "Download it again."
        inside = "".join(f"{name}\n" for name in names).lower().encode()
    groups = tomllib.loads(_FOREIGN.read_text())["group"]
    for remedy, row in ((group["remedy"], row) for group in groups for row in group["files"]):
        begins = tuple(beginning.encode("latin-1") for beginning in row["begins"])
        holds = row.get("holds", [""])
        if (text.startswith(begins) or text.lower().startswith(begins)) and any(
            x.encode() in inside for x in holds
        ):
            return row["what"], remedy
    if meshes := [name for name in names if name.lower().endswith(SUFFIXES)]:
        return (
            f"a zip archive with {', '.join(meshes[:3])}{' …' if len(meshes) > 3 else ''} in it",
            _UNPACK,
        )
    return ("a zip archive without a mesh in it", CONVERT) if zipped else None


def _is_text_stl(start: bytes) -> bool:
    """True for the beginning of an STL file of text; some writers use capitals, or write a mark of
    the encoding.
    """
    text = start[:_START].removeprefix(_MARK).lstrip().lower()
    return text.startswith(b"solid") and re.search(rb"\bfacet\s", text) is not None


@np.errstate(all="ignore")
def _holds_records(start: bytes) -> bool:
    """True if binary STL records with unit normals follow the header, whatever count it
    announces.
    """
    whole = max(len(start) - _STL_HEADER, 0) // _STL_TRIANGLE
    if whole < 4 or start.isascii():
        return False
    rows = np.frombuffer(start, _STL_ROW, whole, _STL_HEADER)
    unit = np.abs(np.linalg.norm(rows["normal"].astype(float), axis=-1) - 1) < 1e-3
    return bool(unit.all()) and _plausible(rows, rows)


def _rows_of_numbers(text: bytes) -> bool:
    """True if the first lines hold three or more numbers each."""
    lines = [line for line in text.splitlines()[:10] if line.strip()]
    return len(lines) > 2 and all(
        re.fullmatch(rb"\s*([-+.\deE]+[\s,;]*){3,}", line) for line in lines[:-1]
    )


def _without_triangles(path: pathlib.Path, kind: str, data: bytes, points: int) -> tuple[str, str]:
    """Fault and remedy of a file without triangles."""
    if b"property float f_dc_0" in data[:_START]:
        return f"{path} is a Gaussian splat of {points} points: it has no triangles.", _SURFACE
    if points:
        return f"{path} has no triangles: it holds only {points} points.", _SURFACE
    fault = f"{path} has no triangles: it holds nothing that can be read as a mesh."
    return fault, f"Export it as a triangle mesh ({kind.upper()})."


def _stl(data: bytes, notes: list[str]) -> trimesh.Trimesh:
    """The triangles of an STL file, each with corners of its own; raises a ValueError if there are
    none.
    """
    corners = (
        _text_stl(data)
        if _is_text_stl(data) and not _is_exact(data, len(data))
        else _binary_stl(data, notes)
    )
    if not len(corners):
        raise ValueError("it has no triangles")
    return trimesh.Trimesh(
        corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False
    )


def _announced(start: bytes) -> int:
    """Number of triangles in the header of a binary STL file."""
    return int.from_bytes(start[_STL_HEADER - 4 : _STL_HEADER], "little")


def _is_exact(start: bytes, size: int) -> bool:
    """True for a binary STL file of `size` bytes with as many triangles as announced, whatever its
    text says.
    """
    return len(start) >= _STL_HEADER and size == _STL_HEADER + _STL_TRIANGLE * _announced(start)


def _text_stl(data: bytes) -> np.ndarray:
    """Corners (F, 3, 3) of text."""
    numbers = array.array(
        "d", (_number(word) for row in _VERTEX.finditer(data) for word in row.groups())
    )
    if len(numbers) % 9:
        raise ValueError("it ends within a triangle, or its facets are not triangles")
    return np.frombuffer(numbers).reshape(-1, 3, 3)


def _number(word: bytes) -> float:
    try:
        return float(word)
    except ValueError:
        raise ValueError(f"{ascii(word.decode(errors='replace'))[:30]} is not a number") from None


def _binary_stl(data: bytes, notes: list[str]) -> np.ndarray:
    """Corners (F, 3, 3) of records; where the header's count is wrong, the whole and plausible
    ones.
    """
    announced, whole = _announced(data), max(len(data) - _STL_HEADER, 0) // _STL_TRIANGLE
    if not whole:
        raise ValueError(
            "it has no triangles: neither text with 'facet' in it, nor whole binary records"
        )
    rows = np.frombuffer(data, _STL_ROW, whole, _STL_HEADER)
    if announced < whole and not _plausible(rows[announced:], rows[: announced or whole]):
        whole = announced
    if whole != announced:
        notes.append(
            f"its header announces {announced} triangles, but it holds {whole}, which were read"
        )
    elif len(data) > _STL_HEADER + _STL_TRIANGLE * whole:
        notes.append(
            f"{len(data) - _STL_HEADER - _STL_TRIANGLE * whole} bytes after its triangles were "
            f"ignored"
        )
    return rows["corners"][:whole].astype(float)


@np.errstate(all="ignore")
def _plausible(rows: np.ndarray, sound: np.ndarray) -> bool:
    """True if records have the values of triangles: not degenerate, and of the size of sound
    ones.
    """
    corners, known = rows["corners"].astype(float), sound["corners"].astype(float)
    if not (np.isfinite(corners).all() and np.isfinite(known).all()):
        return False
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1
    )
    return bool((area > 0).mean() > 0.5 and np.abs(corners).max() < 100 * np.abs(known).max())


def _plain_obj(data: bytes, notes: list[str]) -> bytes:
    """Text with absolute indices, for negative ones count back from the points so far, and without
    dented polygons.

    Raises:
      ValueError: a face has the index 0, or counts back to before the first point.
    """
    data = data.removeprefix(_MARK)
    if b"\n" not in data:
        data = data.replace(b"\r", b"\n")
    data = _INDENT.sub(b"", data).replace(b"\t", b" ")
    if _ZERO.search(data):
        raise ValueError("a face has the index 0, but OBJ counts from 1")
    data = _REMARK.sub(rb"\1", re.sub(rb"\\\r?\n", b" ", data))
    if edges := sum(len(rest.split()) for rest in _LINE.findall(data)):
        notes.append(f"edges left out: {edges}")
    if _RELATIVE.search(data):
        data = _absolute_obj(data)
    return _cut_polygons(data, notes) if _POLYGON.search(data) else data


def _absolute_obj(data: bytes) -> bytes:
    """An OBJ whose negative indices are replaced."""
    counts, lines = {b"v": 0, b"vt": 0, b"vn": 0}, []
    for line in data.splitlines():
        words = line.split()
        if words and words[0] in counts:
            counts[words[0]] += 1
        elif words and words[0] == b"f":
            corners = [
                list(map(_absolute, word.split(b"/"), counts.values())) for word in words[1:]
            ]
            if not all(corner[0] for corner in corners):
                raise ValueError(_NO_POINT)
            line = b" ".join([b"f", *map(b"/".join, corners)])
        lines.append(line)
    return b"\n".join(lines)


def _cut_polygons(data: bytes, notes: list[str]) -> bytes:
    """An OBJ whose dented polygons are cut into triangles inside of them; readers cut all as if
    they had no dent.
    """
    numbers = [row.split()[:3] for row in _POINTS.findall(data)]
    if any(len(row) < 3 for row in numbers):
        raise ValueError("a point has fewer than three numbers")
    points = np.array([_number(word) for row in numbers for word in row]).reshape(-1, 3)
    corners = [row.split() for row in _POLYGON.findall(data)]
    polygons = [[int(corner.partition(b"/")[0]) - 1 for corner in some] for some in corners]
    if max(map(max, polygons)) >= len(points):
        return data  # which is an error of its own
    groups = [some for _, some in alike(np.array([*map(len, polygons)]))]
    cut = cut_dented(points, [np.array([polygons[i] for i in some]) for some in groups], notes)
    text, place = dict[int, bytes](), itertools.count()
    for some, found in zip(groups, cut, strict=True):
        for i, triangles in ((some[k], found[k]) for k in found):
            text[i] = b"\n".join(
                b"f " + b" ".join(corners[i][k] for k in triangle) for triangle in triangles
            )
    return _POLYGON.sub(lambda row: text.get(next(place), row[0]), data)


def _absolute(index: bytes, count: int) -> bytes:
    """The absolute index for one such as -1, among so many points or coordinates so far; empty if
    there is none.
    """
    if not index.startswith(b"-"):
        return index
    return b"%d" % (int(index) + 1 + count) if int(index) >= -count else b""


def sample_colours(
    paths: Sequence[pathlib.Path], seed: int, up: Up = "auto", notes: list[str] | None = None
) -> Colours | None:
    """Samples points evenly over the surfaces of mesh files, with their colours.

    Args:
      paths: the files.
      seed: seed of the points.
      up: axis that points up in the files (`read_mesh`).
      notes: names of missing pictures are appended.

    Returns:
      `COLOUR_POINTS` of them, in the files' unit, z up; None if no file has any colour.

    Raises:
      CongraspError: a file cannot be read with its colours.
    """
    try:
        meshes = [mesh for path in paths for mesh in _meshes(path, up, notes)]
        if not any(_has_colours(mesh.visual) for mesh in meshes):
            return None
        rng = np.random.default_rng(seed)
        areas = np.array([mesh.area for mesh in meshes])
        counts = rng.multinomial(COLOUR_POINTS, areas / areas.sum())
        sampled = [
            _sampled(mesh, int(count), rng)
            for mesh, count in zip(meshes, counts, strict=True)
            if count
        ]
    except Exception as error:  # pictures and texture coordinates of files raise whatever they hold
        reason = (str(error) or type(error).__name__).splitlines()[0][:100].rstrip(" .!")
        raise CongraspError(f"The colours of {paths[0]} cannot be read: {reason}.") from None
    points, colours = (np.concatenate(parts) for parts in zip(*sampled, strict=True))
    return Colours(points, colours)


def _meshes(path: pathlib.Path, up: Up, notes: list[str] | None) -> list[trimesh.Trimesh]:
    """Meshes of a file's scene, placed as in the scene, with z up."""
    loaded = load_geometry(path, "Export it without textures.", notes=notes)
    parts = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
    meshes = [part for part in parts if isinstance(part, trimesh.Trimesh) and part.area > 0]
    for mesh in meshes:
        mesh.vertices = upright(mesh.vertices, up_of(loaded, up))
    return meshes


def _has_colours(visual: Any) -> bool:
    """True if a file specifies the look of a mesh; an unreadable image does not count."""
    if visual is None or visual.kind != "texture":
        return visual is not None and visual.defined
    return _image(visual.material) is not None or tuple(visual.material.main_color[:3]) != _UNSAID


def _image(material: Any) -> Any:
    """Image of a material's colour, if it has one."""
    return getattr(material, "baseColorTexture", None) or getattr(material, "image", None)


def _sampled(
    mesh: trimesh.Trimesh, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Samples points (count, 3) on a mesh, and their colours (count, 3)."""
    points, faces, weights = trimesh.sample.sample_surface(
        mesh, count, return_barycentric=True, seed=rng
    )
    corners = mesh.faces[faces]
    visual: Any = mesh.visual
    if visual.kind == "texture":
        uv = None if visual.uv is None else np.einsum("nk,nkd->nd", weights, visual.uv[corners])
        colours = _material(visual.material, uv, count)
    elif visual.kind == "vertex":
        colours = np.einsum("nk,nkd->nd", weights, visual.vertex_colors[corners])
    else:
        colours = visual.face_colors[faces]
    return points, np.clip(np.round(colours[:, :3]), 0, 255).astype(np.uint8)


def _material(material: Any, uv: np.ndarray | None, count: int) -> np.ndarray:
    """(count, 3) colours from 0 to 255 of a material at texture coordinates (count, 2): its image
    times its colour.
    """
    image = _image(material)
    if image is None or uv is None:
        return np.broadcast_to(np.asarray(material.main_color, float)[:3], (count, 3))
    tint = getattr(material, "baseColorFactor", None)  # an OBJ's image has no tint
    if not np.isfinite(uv).all():
        raise ValueError("texture coordinates are not all numbers")
    whole = np.ones(3) if tint is None else np.asarray(tint, float)[:3] / 255
    return uv_to_interpolated_color(uv, image)[:, :3] * whole
