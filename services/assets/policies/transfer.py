"""Bytes of a file or a web address, within limits of size and time."""

import http
import http.client
import pathlib
import queue
import threading
import time
import urllib.error
import urllib.parse
import urllib.request

from congrasp.common.errors import CongraspError, TransportError

_SCHEMES = ("http", "https")
_CHUNK = 1 << 16
_SILENCE = 20.0
"""Longest silence of a server, s."""
_ENDED_EARLY = "the connection ended early"


def is_web_address(source: str) -> bool:
    """Returns True for an http or https address, False for a path."""
    return urllib.parse.urlsplit(source).scheme.lower() in _SCHEMES


def resolve(base: str, source: str) -> str:
    """Returns an address or path of an index, relative to the address or path of this index.

    Raises:
      CongraspError: an index from the web refers to something else than an http or https address.
    """
    if is_web_address(source):
        return source
    if not is_web_address(base):
        return str(pathlib.Path(base).parent / source)
    address = urllib.parse.urljoin(base, source)
    if not is_web_address(address):
        raise CongraspError(
            f"{base} refers to {source}.", "An index from the web has http and https addresses."
        )
    return address


def read_bytes(source: str, max_bytes: int, deadline: float) -> bytes:
    """Returns the content of a file or a web address.

    Args:
      source: a path, or an http or https address.
      max_bytes: largest size.
      deadline: longest time for a web address, s, including the search for its host.

    Raises:
      CongraspError: the file cannot be read, or the content is too large.
      TransportError: the address cannot be reached, or the time is over.
    """
    if is_web_address(source):
        return _download(source, max_bytes, deadline)
    try:
        with pathlib.Path(source).open("rb") as file:
            content = file.read(max_bytes + 1)
    except OSError as error:
        raise CongraspError(
            f"{source} cannot be read: {error.strerror}.", "Pass a file or a web address."
        ) from None
    if len(content) > max_bytes:
        raise _too_large(source, max_bytes)
    return content


def _download(address: str, max_bytes: int, deadline: float) -> bytes:
    """Returns the content of a web address; see `read_bytes`."""
    outcomes: queue.SimpleQueue[bytes | CongraspError] = queue.SimpleQueue()
    end = time.monotonic() + deadline

    def work() -> None:
        try:
            outcomes.put(_read_web(address, max_bytes, end))
        except CongraspError as error:
            outcomes.put(error)

    # The search for a host has no deadline, and cannot be interrupted
    threading.Thread(target=work, daemon=True, name="download").start()
    try:
        outcome = outcomes.get(timeout=deadline)
    except queue.Empty:
        raise _late(address) from None
    if isinstance(outcome, CongraspError):
        raise outcome
    return outcome


def _read_web(address: str, max_bytes: int, end: float) -> bytes:
    """Returns the content of a web address.

    Args:
      address: of http or https, to which redirections are limited, too.
      max_bytes: largest size.
      end: `time.monotonic()` after which no more is read.

    Raises:
      CongraspError: the content is too large.
      TransportError: the address cannot be reached, or the time is over.
    """
    content = bytearray()
    silence = max(0.1, min(_SILENCE, end - time.monotonic()))
    try:
        with _opener().open(address, timeout=silence) as reply:
            while chunk := reply.read1(_CHUNK):
                content += chunk
                if len(content) > max_bytes:
                    raise _too_large(address, max_bytes)
                if time.monotonic() > end:
                    raise _late(address)
            if reply.length:
                raise _unreachable(address, _ENDED_EARLY)
    except urllib.error.HTTPError as error:
        raise _refused(address, error.code) from None
    except TimeoutError:
        raise _late(address) from None
    except urllib.error.URLError as error:
        if isinstance(error.reason, TimeoutError):
            raise _late(address) from None
        raise _unreachable(address, _cause(error.reason)) from None
    except http.client.IncompleteRead:
        raise _unreachable(address, _ENDED_EARLY) from None
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise _unreachable(address, _cause(error)) from None
    return bytes(content)


def _cause(error: BaseException | str) -> str:
    """Text of an error, without the number of an error of the system."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return str(error)


def _opener() -> urllib.request.OpenerDirector:
    """Returns what opens http and https, by the proxies of the environment, and nothing else."""
    opener = urllib.request.OpenerDirector()
    for handler in (
        urllib.request.ProxyHandler(),
        urllib.request.HTTPHandler(),
        urllib.request.HTTPSHandler(),
        urllib.request.HTTPDefaultErrorHandler(),
        urllib.request.HTTPRedirectHandler(),
        urllib.request.HTTPErrorProcessor(),
        urllib.request.UnknownHandler(),
    ):
        opener.add_handler(handler)
    return opener


def _too_large(source: str, max_bytes: int) -> CongraspError:
    """Returns the error about content that exceeds the limit."""
    return CongraspError(
        f"{source} is larger than the {max_bytes} bytes that are expected.",
        "Check the address, and a policy's size in the index.",
    )


def _refused(address: str, code: int) -> TransportError:
    """Returns the error about a server that answers with an error.

    Args:
      address: of the request.
      code: status of the answer, below 400 for a redirection that is not followed.
    """
    if code < http.HTTPStatus.BAD_REQUEST:
        return TransportError(
            f"{address} redirects without end, or not to http or https ({code}).",
            "Check the address.",
        )
    remedy = "Check the address."
    if code >= http.HTTPStatus.INTERNAL_SERVER_ERROR:
        remedy = "Try again later."
    answer = f"{code} {http.client.responses.get(code, '')}".rstrip()
    return TransportError(f"{address} answers {answer}.", remedy)


def _late(address: str) -> TransportError:
    """Returns the error about an address that takes too long."""
    return TransportError(
        f"{address} did not send everything in time.",
        "Check the connection, or raise --timeout.",
    )


def _unreachable(address: str, reason: str) -> TransportError:
    """Returns the error about an address that does not answer."""
    return TransportError(
        f"{address} cannot be reached: {reason}.",
        "Check the connection. Policies of the package need none.",
    )
