"""Senders whose requests the page of a studio answers: the page itself, and no other site."""

import re
from collections.abc import Mapping, Sequence

_LOOPBACK = ("127.0.0.1", "localhost", "::1")


class Access:
    """Names under which a page is offered.

    Other sites in the browser must not reach the page. A site's name may resolve to this machine
    (DNS rebinding), so the Host header must name this machine, or a proxy set by the user. Ports
    differ behind a tunnel.
    """

    def __init__(self, host: str, port: int, names: Sequence[str]):
        """Admits requests for a page.

        Args:
          host: interface; on loopback, only requests to a loopback name or one of `names` are
            admitted.
          port: TCP port.
          names: names under which a proxy offers the page.
        """
        self._host = host
        self._port = port
        self._proxy_names = set(names)
        self._names = {*_LOOPBACK, *names} if host in _LOOPBACK else None

    @property
    def url(self) -> str:
        """URL of the page for a browser on this machine."""
        host = self._host
        if host in ("0.0.0.0", "::", ""):
            host = "127.0.0.1"
        elif ":" in host:
            host = f"[{host}]"
        return f"http://{host}:{self._port}/"

    def fault(self, headers: Mapping[str, str]) -> str:
        """Returns the reason why a request is refused, with the remedy; empty if it comes from the
        page itself.

        Args:
          headers: by their names in lower case.
        """
        host = headers.get("host", "").strip()
        return self._host_fault(host) or self._origin_fault(host, headers)

    def _host_fault(self, host: str) -> str:
        """Reason why a Host header is refused; empty if it names this page."""
        name = re.sub(r":\d*$", "", host).strip("[]")
        if host and (self._names is None or {host, name} & self._names):
            return ""
        shown_name = ascii(name)[:60]
        return (
            f"The page is not offered as {shown_name}. Open {self.url} or start it with "
            f"--allow-host {shown_name}."
        )

    def _origin_fault(self, host: str, headers: Mapping[str, str]) -> str:
        """Reason why the sender of a request is refused; empty if it is this page."""
        origin = headers.get("origin")
        site = headers.get("sec-fetch-site")
        sender = re.sub(r"^https?://|:\d*$", "", origin or "").strip("[]")
        # A proxy may put this server's address as Host, and leave the browser's Origin.
        is_page = (
            origin in (None, f"http://{host}", f"https://{host}") or sender in self._proxy_names
        )
        if is_page and site in (None, "none", "same-origin"):
            return ""
        proxy = ""
        if sender:
            proxy = (
                f" If that is a proxy of yours, start it with --allow-host {ascii(sender)[:60]}."
            )
        return f"Another site sent this request. Open the page itself, at {self.url}.{proxy}"
