"""Texts of robot descriptions: encodings, entities, and the files that they include."""

import pathlib
import re
import stat
from typing import NamedTuple

from congrasp.services.assets.hands.reading import MAX_FILE, FaultyFile

_MAX_FILES = 300
"""XML files that a description includes or attaches."""
_ELEMENT = re.compile(r"<(\w+)([^<>]*)")
_FILE = re.compile(r"""\bfile\w*\s*=\s*["']([^"']+)["']""")
"""Attribute with a file; a texture of a cube has six, such as `fileright`."""
_FOLDER = re.compile(r"""\b(?:meshdir|texturedir|assetdir)\s*=\s*["']([^"']+)["']""")
_ENCODING = re.compile(rb"""[^>]{0,200}?encoding\s*=\s*["']([\w-]+)""")
_WIDE_ENCODINGS = {
    b"\xff\xfe": "utf-16",
    b"\xfe\xff": "utf-16",
    b"<\0": "utf-16-le",
    b"\0<": "utf-16-be",
}
"""Encodings of two bytes a character, by the first bytes."""
_PROLOG = re.compile(
    r"""
    <!--.*?(?:-->|\Z)  # a comment
    | <\?.*?(?:\?>|\Z)  # the XML declaration, or another instruction
    | <!ENTITY
    | <(?!!)  # the root element, if nothing above matches
    """,
    re.DOTALL | re.VERBOSE,
)
"""Items before the root element, and the beginning of that element."""


class Texts(NamedTuple):
    """The texts of a description."""

    main: str
    included: dict[str, str]
    """Texts of included XML files, by their names in the description."""
    attached: dict[str, str]
    """Texts of attached models, by their names in the description."""

    def all(self) -> list[str]:
        """Returns all texts, the main one first."""
        return [self.main, *self.included.values(), *self.attached.values()]


def read_texts(path: pathlib.Path) -> Texts:
    """Reads a description, and the XML files that it includes and attaches.

    Raises:
      FaultyFile: it names a pipe or a device, which would block, or declares entities.
      ValueError: it includes and attaches too many files; or see `robot_text`.
    """
    texts = Texts(robot_text(path), {}, {})
    by_tag = {"include": texts.included, "model": texts.attached}  # MJCF: <model file="..."/>
    unread = [("", texts.main)]
    for _, text in unread:  # which grows
        for tag, file in _named_files(text):
            if tag not in by_tag or file in by_tag[tag] or not (path.parent / file).is_file():
                continue
            by_tag[tag][file] = robot_text(path.parent / file)
            unread.append((file, by_tag[tag][file]))
            if len(texts.included) + len(texts.attached) > _MAX_FILES:
                raise ValueError(f"it names more than {_MAX_FILES} files")
    _check_named_files(path.parent, unread)
    return texts


def _named_files(text: str) -> list[tuple[str, str]]:
    """Files that a text names: the tag of the element, and the name with slashes."""
    files = []
    for tag, attributes in _ELEMENT.findall(text):
        for written_name in _FILE.findall(attributes):
            files.append((tag, written_name.replace("\\", "/")))
    return files


def _check_named_files(root: pathlib.Path, texts: list[tuple[str, str]]) -> None:
    """Raises a FaultyFile if a named file is a pipe or a device where MuJoCo may search for it.

    MuJoCo opens meshes and pictures later. A folder such as `meshdir` applies to all included
    texts, wherever it is declared; it is relative to the main description or to an attached model.

    Args:
      root: folder of the main description.
      texts: names of the files with a description, relative to `root`, and their texts.
    """
    declared = {""}
    for _, text in texts:
        declared.update(_FOLDER.findall(text))
    for name, text in texts:
        folders = _search_folders(pathlib.PurePath(name).parent, declared)
        for _, file in _named_files(text):
            for folder in folders:
                _check_regular(root / folder / file, file)


def _search_folders(parent: pathlib.PurePath, declared: set[str]) -> set[pathlib.PurePath]:
    """Folders in which MuJoCo may search for the files that a text names.

    Args:
      parent: folder of the text, relative to the main description.
      declared: folders that the texts declare.
    """
    folders = set()
    for folder in declared:
        folders.add(pathlib.PurePath(folder))
        folders.add(parent / folder)
        folders.add(folder / parent)
    return folders


def robot_text(path: pathlib.Path) -> str:
    """Returns the text of an XML file from its first element on, in whatever encoding.

    Raises:
      FaultyFile: it declares entities.
      ValueError: it is too large, or has an unknown encoding.
    """
    if path.stat().st_size > MAX_FILE:
        raise ValueError(f"{path.name} has more than {MAX_FILE >> 20} MB")
    data = path.read_bytes()
    encoding = _encoding(data)
    try:
        text = data.decode(encoding, errors="replace")
    except LookupError:
        raise ValueError(f"{path.name} has the unknown encoding '{encoding[:30]}'") from None
    for mark in _PROLOG.finditer(text):
        if mark[0] == "<":
            return text[mark.start() :]
        if mark[0] == "<!ENTITY":
            raise FaultyFile(
                f"{path.name} declares entities, which are not read. Export it without a DOCTYPE"
            )
    return ""


def _encoding(data: bytes) -> str:
    """Name of the encoding of an XML file."""
    if data[:2] in _WIDE_ENCODINGS:
        return _WIDE_ENCODINGS[data[:2]]
    declared = _ENCODING.match(data)
    if declared is None or declared[1].decode().lower() in ("utf-8", "utf8"):
        return "utf-8-sig"
    return declared[1].decode()


def _check_regular(path: pathlib.Path, name: str) -> None:
    """Raises a FaultyFile for a pipe or a device, which the description calls `name`."""
    if path.exists() and not stat.S_ISREG(path.stat().st_mode):
        raise FaultyFile(f"the file '{name}' that it names is no regular file. Name one that is")
