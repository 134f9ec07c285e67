"""Texts of robot descriptions: encodings, entities, and the files that they include."""

import pathlib
import re
import stat
from typing import NamedTuple

from congrasp.services.assets.hands.reading import MAX_FILE, FaultyFile

_MAX_FILES = 300
"""XML files that a description includes or attaches."""
_NAMED_FILE = re.compile(r"""<(\w+)[^<>]*?\bfile\w*\s*=\s*["']([^"']+)["']""")
_FOLDER = re.compile(r"""\b(?:meshdir|texturedir|assetdir)\s*=\s*["']([^"']+)["']""")
_ENCODING = re.compile(rb"""[^>]{0,200}?encoding\s*=\s*["']([\w-]+)""")
_WIDE_ENCODINGS = {
    b"\xff\xfe": "utf-16",
    b"\xfe\xff": "utf-16",
    b"<\0": "utf-16-le",
    b"\0<": "utf-16-be",
}
"""Encodings of two bytes a character, by the first bytes."""
_PROLOG = re.compile(r"<!--.*?(?:-->|\Z)|<\?.*?(?:\?>|\Z)|<!ENTITY|<(?!!)", re.DOTALL)
"""Comments, declarations and entities before the root element, and the beginning of that."""


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
      ValueError: it names a pipe or a device, which would block, or too many files.
    """
    texts = Texts(robot_text(path), {}, {})
    by_tag = {"include": texts.included, "model": texts.attached}
    unread = [("", texts.main)]
    for name, text in unread:  # which grows
        folders = {"", *_FOLDER.findall(text), str(pathlib.PurePath(name).parent)}
        for tag, windows_name in _NAMED_FILE.findall(text):
            file = windows_name.replace("\\", "/")
            for folder in folders:
                _check_regular(path.parent / folder / file, file)
            if tag not in by_tag or file in by_tag[tag] or not (path.parent / file).is_file():
                continue
            by_tag[tag][file] = robot_text(path.parent / file)
            unread.append((file, by_tag[tag][file]))
            if len(unread) > _MAX_FILES:
                raise ValueError(f"it names more than {_MAX_FILES} files")
    return texts


def robot_text(path: pathlib.Path) -> str:
    """Returns the text of an XML file from its first element on, in whatever encoding.

    Raises:
      ValueError: it is too large, has an unknown encoding, or declares entities.
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
