"""Requests that the page of a studio sends: their handlers by path, and the answers of these."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from congrasp.common.errors import CongraspError
from congrasp.common.wire.codec import Message


class BadRequest(CongraspError):
    """A malformed request; the page sends none."""


class Download(NamedTuple):
    """Bytes that a browser saves under a name."""

    name: str
    data: bytes


class Picture(NamedTuple):
    """A PNG file's content, which a browser shows."""

    png: bytes


Answer = dict[str, Any] | list[Any] | Message | Download | Picture
Get = Callable[[Mapping[str, str]], Answer]
"""Query parameters to answer."""
Post = Callable[[Mapping[str, str], bytes], Answer]
"""Query parameters and body to answer."""


class Routes(NamedTuple):
    """Handlers of requests, by path."""

    gets: Mapping[str, Get]
    posts: Mapping[str, Post]
