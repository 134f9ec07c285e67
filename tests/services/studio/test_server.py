"""The server answers only its page, and every request with a result or a message."""

import contextlib
import http.client
import io
import itertools
import json
import pathlib
import re
import socket
import threading
import time
import urllib.parse
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image

from congrasp.common.episode.motion_file import load_motion
from congrasp.common.errors import CongraspError
from congrasp.common.wire.codec import decode
from congrasp.services.cli.main import main
from congrasp.services.ops import http_connections
from congrasp.services.ops.http_server import listening_socket
from congrasp.services.record.reader import read_episodes
from congrasp.services.studio import application, browser_sessions
from congrasp.services.studio import page as page_module
from congrasp.services.studio import server as server_module
from congrasp.services.studio.application import STATIC
from congrasp.services.studio.catalogue import Uploads
from congrasp.services.studio.recordings import Recordings
from congrasp.services.studio.routes import Picture, Routes
from congrasp.services.studio.server import PageServer
from congrasp.services.studio.session import Session
from congrasp.services.studio.training import TrainingWindow
from tests import studio as fake
from tests.waits import eventually


class Page:
    """Sends requests as a browser does."""

    def __init__(self, port: int):
        self.port = port

    def ask(self, method: str, path: str, body: bytes = b"", **headers: str) -> tuple[int, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        kind = {"Content-Type": "application/json"} if method == "POST" else {}
        connection.request(
            method,
            path,
            body or None,
            {**kind, **{k.replace("_", "-"): v for k, v in headers.items()}},
        )
        answer = connection.getresponse()
        reply = answer.status, answer.read()
        connection.close()
        return reply

    def get(self, path: str) -> dict[str, Any]:
        return json.loads(self.ask("GET", path)[1])

    @property
    def state(self) -> dict[str, Any]:
        return self.get("/api/state")

    def do(self, action: str, **values: Any) -> dict[str, Any]:
        code, reply = self.ask("POST", "/api/do", json.dumps({"action": action, **values}).encode())
        assert code == 200
        return json.loads(reply)

    def upload(self, name: str, content: bytes = b"solid") -> dict[str, Any]:
        kind = "application/octet-stream"
        return json.loads(
            self.ask("POST", f"/api/upload?name={name}", content, Content_Type=kind)[1]
        )

    def wait(self) -> dict[str, Any]:
        """The job once it has ended, without an error."""
        while (job := self.get("/api/job"))["running"]:
            time.sleep(0.02)
        assert job["error"] == ""
        return job


@pytest.fixture(scope="module")
def grasping() -> fake.FakePolicy:
    return fake.FakePolicy()


@pytest.fixture(scope="module")
def page(grasping: fake.FakePolicy) -> Iterator[Page]:
    session: Session = fake.session(grasping, window=fake.window(5))
    server = PageServer(lambda browser: session.routes, "127.0.0.1", 0)
    yield Page(server.port)
    server.close()
    session.close()


def test_only_the_page_and_its_modules_are_served(page: Page) -> None:
    assert b"<title>congrasp" in page.ask("GET", "/")[1]
    assert page.ask("GET", "/static/picture.js")[0] == 200
    assert page.ask("GET", "/prefix/static/vendor/three.module.min.js")[0] == 200
    hostile = ("HTTP://[", f"/static/{'a' * 300}.css", "/static/%00.css")
    for path in (
        "/static/../server.py",
        "/static/%2e%2e/server.py",
        "/etc/passwd",
        "/static/",
        "/api/none",
        *hostile,
    ):
        assert page.ask("GET", path)[0] == 404, path


def test_a_result_that_is_not_json_is_answered() -> None:
    server = PageServer(
        lambda browser: Routes({"/api/nan": lambda query: {"x": float("nan")}}, {}), "127.0.0.1", 0
    )
    code, reply = Page(server.port).ask("GET", "/api/nan")
    server.close()
    assert code == 500
    assert "ValueError" in json.loads(reply)["error"]


def test_every_browser_has_a_separate_session(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cookie identifies it, edits and undo are separate, and beyond the limit the least recent
    idle one ends.
    """
    monkeypatch.setattr(browser_sessions, "MAX_SESSIONS", 2)
    sessions_made: list[Session] = []

    def new() -> Session:
        sessions_made.append(fake.session(fake.FakePolicy()))
        return sessions_made[-1]

    sessions = browser_sessions.Sessions(new)
    server = PageServer(sessions.routes, "127.0.0.1", 0)
    page = Page(server.port)

    def open_page(**headers: str) -> str:
        connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
        connection.request("GET", "/", headers=headers)
        with contextlib.closing(connection):
            return connection.getresponse().headers["Set-Cookie"] or ""

    def undoable(cookie: str) -> bool:
        return bool(json.loads(page.ask("GET", "/api/state", Cookie=cookie)[1])["history"]["undo"])

    try:
        cookies = [open_page().partition(";")[0] for _ in range(3)]
        assert len(set(cookies)) == 3
        assert all(c.startswith(f"congrasp-{server.port}=") for c in cookies)
        assert open_page(Cookie=cookies[0]) == ""
        assert "HttpOnly; SameSite=Strict" in open_page(Cookie="congrasp=x")
        body = json.dumps({"action": "fill", "avoid": True}).encode()
        assert page.ask("POST", "/api/do", body, Cookie=cookies[0])[0] == 200
        assert [undoable(cookie) for cookie in cookies[:2]] == [True, False]
        assert len(sessions_made) == 2
        assert undoable(cookies[0])  # used more recently than the second
        for path, kind in (("/api/state", "GET"), ("/api/do", "POST")):
            refused = json.loads(
                page.ask(kind, path, body if kind == "POST" else b"", Cookie=cookies[2])[1]
            )
            assert "2 browsers, the maximum, use" in refused["error"]
            assert len(sessions_made) == 2
        monkeypatch.setattr(browser_sessions, "IDLE_S", 0.0)
        assert not undoable(cookies[2])
        assert len(sessions_made) == 3
        assert undoable(cookies[0])
        assert not undoable(cookies[1])
        assert len(sessions_made) == 4
    finally:
        server.close()
        sessions.close()


def test_a_hundred_simultaneous_connections_are_accepted() -> None:
    with listening_socket("127.0.0.1", 0) as listener, contextlib.ExitStack() as stack:
        for _ in range(100):  # none is accepted yet
            stack.enter_context(socket.create_connection(listener.getsockname(), 10.0))


def test_browser_of_another_address_is_served_when_full() -> None:
    with (
        contextlib.closing(PageServer(lambda browser: Routes({}, {}), "127.0.0.1", 0)) as server,
        contextlib.ExitStack() as stack,
    ):
        address = ("127.0.0.1", server.port)
        crowd = [
            stack.enter_context(socket.create_connection(address, timeout=10.0)) for _ in range(256)
        ]
        refused = stack.enter_context(socket.create_connection(address, timeout=10.0))
        assert refused.recv(1 << 12).startswith(b"HTTP/1.1 503 ")
        other = socket.create_connection(address, 10.0, source_address=("127.0.0.2", 0))
        stack.enter_context(other)
        other.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert other.recv(1 << 12).startswith(b"HTTP/1.1 200 ")
        assert crowd[-1].recv(1) == b""
        crowd[0].sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert crowd[0].recv(1 << 12).startswith(b"HTTP/1.1 200 ")


def test_a_head_that_never_ends_is_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its bytes come too often for the limit of silence."""
    monkeypatch.setattr(http_connections, "TIMEOUT_S", 0.5)
    with (
        contextlib.closing(PageServer(lambda browser: Routes({}, {}), "127.0.0.1", 0)) as server,
        socket.create_connection(("127.0.0.1", server.port), timeout=10.0) as slow,
        pytest.raises((BrokenPipeError, ConnectionResetError)),
    ):
        for byte in itertools.chain(b"GET / HTTP/1.1\r\nHost: ", itertools.repeat(65, 1000)):
            slow.sendall(bytes([byte]))
            time.sleep(0.02)


def test_a_client_that_does_not_read_loses_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http_connections, "TIMEOUT_S", 0.5)
    monkeypatch.setattr(server_module, "MAX_CONNECTIONS", 1)
    large = Routes({"/api/large": lambda query: Picture(bytes(64 << 20))}, {})
    with (
        contextlib.closing(PageServer(lambda browser: large, "127.0.0.1", 0)) as server,
        socket.create_connection(("127.0.0.1", server.port), timeout=10.0) as client,
    ):
        client.sendall(b"GET /api/large HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert client.recv(1, socket.MSG_PEEK)

        def code_of_another() -> int:
            other = http.client.HTTPConnection(
                "127.0.0.1", server.port, timeout=10, source_address=("127.0.0.2", 0)
            )
            with contextlib.closing(other):
                other.request("GET", "/")
                return other.getresponse().status

        assert code_of_another() == 503
        eventually(lambda: code_of_another() == 200, 0.1)


def _posted(server: PageServer, path: str) -> socket.socket:
    """A connection that has sent the head of a request whose body is 1 MB long."""
    connection = socket.create_connection(("127.0.0.1", server.port), timeout=10.0)
    head = (
        f"POST {path} HTTP/1.1",
        "Host: 127.0.0.1",
        "Content-Type: application/json",
        "Content-Length: 1000000",
    )
    connection.sendall("\r\n".join([*head, "", ""]).encode())
    return connection


def test_silence_within_a_body_is_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(application, "SILENCE_S", 0.2)
    routes = Routes({}, {"/api/do": lambda query, body: {}})
    with (
        contextlib.closing(PageServer(lambda browser: routes, "127.0.0.1", 0)) as server,
        _posted(server, "/api/do") as connection,
    ):
        connection.sendall(b"{")
        assert connection.recv(1 << 16).startswith(b"HTTP/1.1 408 ")


def test_rest_of_a_refused_body_is_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http_connections, "REST_S", 0.2)
    with (
        contextlib.closing(PageServer(lambda browser: Routes({}, {}), "127.0.0.1", 0)) as server,
        _posted(server, "/api/none") as connection,
        pytest.raises((BrokenPipeError, ConnectionResetError)),
    ):
        for _ in range(1000):
            connection.sendall(b" ")
            time.sleep(0.02)


def test_other_sites_are_rejected(page: Page) -> None:
    same_site = {
        "Host": f"localhost:{page.port}",
        "Origin": f"http://localhost:{page.port}",
        "Sec_Fetch_Site": "same-origin",
    }
    assert page.ask("GET", "/api/state", **same_site)[0] == 200
    for other in (
        "Host=evil.example:80",
        "Origin=http://evil.example",
        "Sec_Fetch_Site=cross-site",
        "Sec_Fetch_Site=same-site",
    ):
        name, _, value = other.partition("=")
        assert page.ask("GET", "/api/state", **{**same_site, name: value})[0] == 403, other


def test_a_tunnel_and_a_named_proxy_reach_the_page() -> None:
    """`ssh -L 9000:localhost:7480` keeps the browser's Host; a proxy of a notebook ends TLS."""
    server = PageServer(
        lambda browser: Routes({"/api/state": lambda query: {}}, {}),
        "127.0.0.1",
        0,
        ["hub.example.org"],
    )
    page = Page(server.port)

    def code(**headers: str) -> int:
        return page.ask("GET", "/api/state", **headers)[0]

    try:
        assert (
            code(
                Host="localhost:9000", Origin="http://localhost:9000", Sec_Fetch_Site="same-origin"
            )
            == 200
        )
        assert code(Host="hub.example.org", Origin="https://hub.example.org") == 200
        # nginx puts the address behind it as Host and leaves the browser's Origin.
        address = f"127.0.0.1:{server.port}"
        assert code(Host=address, Origin="https://hub.example.org") == 200
        refused = page.ask("GET", "/", Host=address, Origin="https://other.example")
        assert refused[0] == 403
        assert "--allow-host 'other.example'" in json.loads(refused[1])["error"]
        assert (
            code(Host=address, Origin="https://hub.example.org", Sec_Fetch_Site="cross-site") == 403
        )
        assert code(Host="localhost:9000", Origin="http://localhost:9001") == 403
        assert code(Host="hub.example.org", Origin="https://evil.example") == 403
        refused = page.ask("GET", "/", Host="other.example.org")
        assert refused[0] == 403
        assert "--allow-host 'other.example.org'" in json.loads(refused[1])["error"]
        assert (
            page.ask("GET", "/user/me/proxy/7480/api/state")[0]
            == page.ask("GET", "/user/me/")[0]
            == 200
        )
        for file in filter(
            pathlib.Path.is_file, STATIC.rglob("*")
        ):  # a proxy offers the page below a prefix
            assert not re.search(r"[\"'`]/(api|static)/", file.read_text())
    finally:
        server.close()


@pytest.mark.parametrize(
    ("body", "says"),
    [
        (b"", "JSON"),
        (b"[1]", "JSON"),
        (b"[" * 100_000, "JSON"),
        (b'{"action": ["fill"]}', "no action"),
        (b'{"action": "set_rest_pose", "rest": 0.5}', "no resting pose '0.5'"),
        (b'{"action": "draw", "points": [[0, 0, 0], [1]]}', "Invalid value for 'draw'"),
        (b'{"action": "draw", "points": [[1e308, 0, 0], [-1e308, 0, 0]]}', "within"),
        (
            b'{"action": "paint", "points": [["x", 0, 0]], "radius": 0.01, "avoid": true}',
            "Invalid value for 'paint'",
        ),
        (b'{"action": "set_heading", "surface": [1e308, 0, 0], "direction": [0, 0, 1]}', "within"),
        (b'{"action": "explode"}', "no action 'explode'"),
        (b'{"action": "\\ud800"}', "no action"),
        (b'{"action": "set_roll", "turns": 2}', "Invalid value"),
        (b'{"action": "object", "name": "moon"}', "no object 'moon'"),
        (b'{"action": "unit", "unit": "cm"}', "Open a mesh"),
        (b'{"action": "draw_motion", "id": "7", "kind": "png", "camera": {}}', "no motion '7'"),
    ],
)
def test_wrong_requests_are_answered_with_a_message(page: Page, body: bytes, says: str) -> None:
    code, reply = page.ask("POST", "/api/do", body)
    assert code == 200
    assert says in json.loads(reply)["error"]


def test_a_body_without_length_or_beyond_the_limit_is_refused_unread(page: Page) -> None:
    for length, code in ((str(1 << 40), 413), ("-5", 400), ("many", 400), ("9" * 5000, 400)):
        assert page.ask("POST", "/api/upload?name=a.stl", b"", Content_Length=length)[0] == code


def test_chunked_body_is_refused_with_and_without_length(page: Page) -> None:
    chunked = {"Transfer_Encoding": "chunked"}
    for length in ({}, {"Content_Length": "3"}):
        assert page.ask("POST", "/api/upload?name=a.stl", b"", **chunked, **length)[0] == 413


@pytest.mark.parametrize(
    ("header", "code"),
    [
        ("Origin: http://evil.example", 403),
        ("Sec-Fetch-Site: cross-site", 403),
        ("Content-Type: text/plain", 403),
        ("Host: evil.example", 403),
        ("X-Nothing: else", 404),
    ],
)
def test_a_refused_request_is_answered_before_its_body_arrives(
    page: Page, header: str, code: int
) -> None:
    right = (
        f"Host: 127.0.0.1:{page.port}",
        "Content-Type: application/json",
        f"Content-Length: {128 << 20}",
    )
    lines = [line for line in right if line.partition(":")[0] not in header] + [header]
    with socket.create_connection(("127.0.0.1", page.port), timeout=10) as connection:
        connection.sendall("\r\n".join(["POST /api/none HTTP/1.1", *lines, "", ""]).encode())
        assert connection.recv(1 << 16).startswith(f"HTTP/1.1 {code} ".encode())


@pytest.mark.parametrize(("host", "code"), [("", 400), ("Host:\r\n", 403), ("Host:  \r\n", 403)])
def test_a_request_for_no_host_is_refused_on_every_interface(host: str, code: int) -> None:
    server = PageServer(lambda browser: Routes({"/api/state": lambda query: {}}, {}), "0.0.0.0", 0)
    try:
        with socket.create_connection(("127.0.0.1", server.port), timeout=20) as connection:
            connection.sendall(f"GET /api/state HTTP/1.1\r\n{host}\r\n".encode())
            assert connection.recv(1 << 16).startswith(f"HTTP/1.1 {code} ".encode())
    finally:
        server.close()


def test_a_hand_is_named_and_no_file_opened(page: Page, tmp_path: pathlib.Path) -> None:
    file = pathlib.Path(__file__).parents[2] / "hands" / "claw.json"
    assert b"skin_points" in page.ask("GET", "/api/hand?name=allegro")[1]
    assert b"skin_points" in page.ask("GET", "/api/hand?name=human")[1]
    assert b"not a built-in hand" in page.ask("GET", f"/api/hand?name={file}")[1]
    text = urllib.parse.quote(file.read_text())
    assert b"skin_points" in page.ask("GET", f"/api/hand?name={text}")[1]  # as a motion of it does


def test_paint_of_no_colour_leaves_the_studio_working(page: Page) -> None:
    page.do("paint", points=[[0, 0, 0]], radius=0.01, avoid=float("nan"))
    assert page.state
    assert page.do("fill", avoid=False)


def test_a_malformed_request_is_a_bad_request(tmp_path: pathlib.Path) -> None:
    fake.record(tmp_path, [(fake.BEGIN, 1)])
    session = fake.session(window=TrainingWindow("fake", Recordings(tmp_path)))
    server = PageServer(lambda browser: session.routes, "127.0.0.1", 0)
    page = Page(server.port)
    try:
        for name in ("..", "a/..", "a%00.stl", "a%0A.stl", "a" * 300, "%F0%9F%8D%90" * 64):
            code, reply = page.ask("POST", f"/api/upload?name={name}", b"solid")
            assert (code, "is not a file name" in json.loads(reply)["error"]) == (400, True), name
        for time_ in ("nan", "inf", "-inf", "1e300", "-1"):
            assert page.ask("GET", f"/api/episodes?time={time_}&seconds=1")[0] == 400, time_
        assert page.ask("GET", f"/api/episodes?time={fake.BEGIN}&seconds=nan")[0] == 400
        assert (
            len(
                json.loads(page.ask("GET", f"/api/episodes?time={fake.BEGIN}&seconds=1")[1])[
                    "episodes"
                ]
            )
            == 1
        )
    finally:
        server.close()
        session.close()


def test_the_mass_of_an_object_is_set(page: Page, grasping: fake.FakePolicy) -> None:
    def mass() -> float:
        return page.state["studio"]["object"]["mass_g"]

    estimated = mass()
    page.do("weigh", mass_g=500)
    page.do("grasp")
    assert page.wait()
    assert grasping.asked[-1][0].mass == 0.5
    assert mass() == 500
    page.do("weigh", material="steel")
    assert mass() not in (500, estimated)
    assert "The mass is 9e+09 g" in page.do("weigh", mass_g=9e9)["error"]
    page.do("weigh")
    assert mass() == estimated


class HeldImporter(fake.FakeImporter):
    """Finishes an import once it may."""

    def __init__(self) -> None:
        self.may_end = threading.Event()

    def load(self, path: pathlib.Path, unit: str) -> Any:
        self.may_end.wait()
        return super().load(path, unit)


@pytest.mark.parametrize("moment", ["before", "during", "after"])
def test_a_mass_set_during_an_import_is_that_of_its_object(moment: str) -> None:
    importer = HeldImporter()
    session = Session({"fake": fake.FakePolicy}, fake.objects(), importer)
    server = PageServer(lambda browser: session.routes, "127.0.0.1", 0)
    page = Page(server.port)
    try:
        if moment == "before":
            page.do("weigh", mass_g=250)
        page.upload("mug.stl")
        if moment == "during":
            page.do("weigh", mass_g=250)
        importer.may_end.set()
        page.wait()
        if moment == "after":
            page.do("weigh", mass_g=250)
        state = page.state
    finally:
        server.close()
        session.close()
    assert state["chosen"] == "bottle_5"
    is_set = moment != "before"
    assert (state["studio"]["object"]["mass_g"] == 250) == is_set
    assert (state["weight"]["mass_g"] == 250) == is_set


def test_a_grasp_gets_the_phases_that_were_set(page: Page, grasping: fake.FakePolicy) -> None:
    page.do("time", approach=1.5, lift=0.2)
    page.do("time", hold=1)
    page.do("grasp")
    assert page.wait()
    assert grasping.asked[-1][2] == (1.5, 0.2, 1.0)
    for phase in ({"lift": 0.6}, {"hold": -1}, {"speed": 1.0}):
        assert "approach 0 to 10, lift 0 to 0.5" in page.do("time", **phase)["error"], phase
    assert page.state["phases"] == {"approach": 1.5, "lift": 0.2, "hold": 1.0}


def test_a_grasp_from_request_to_files(
    page: Page, grasping: fake.FakePolicy, tmp_path: pathlib.Path
) -> None:
    page.do("paint", points=[[0.0, 0.0, 0.04]], radius=0.03, avoid=True)
    page.do("grasp")
    page.wait()
    assert tuple(grasping.asked[-1][1].constraints) == ("heading", "affordance")
    motions = page.state["motions"]
    assert motions[0]["held"]
    assert motions[0]["steps"] == fake.STEPS
    assert motions[0]["asked"].endswith("from the side")
    played = decode(page.ask("GET", f"/api/motion?id={motions[0]['id']}")[1])
    assert played.arrays["lane/affordance/met"].shape == (fake.STEPS,)
    for kind in ("npz", "mcap"):
        (tmp_path / f"m.{kind}").write_bytes(
            page.ask("GET", f"/api/export?id={motions[0]['id']}&kind={kind}")[1]
        )
    motion = load_motion(tmp_path / "m.npz")
    np.testing.assert_array_equal(motion.link_position, played.arrays["link_position"])
    (episode,) = read_episodes(tmp_path / "m.mcap")
    np.testing.assert_array_equal(episode.link_position, played.arrays["link_position"])
    assert b"Choose from: npz, mcap, glb" in page.ask("GET", "/api/export?id=1&kind=docx")[1]


def test_a_fault_inside_is_shown_and_the_studio_continues(
    page: Page, grasping: fake.FakePolicy
) -> None:
    grasping.fails = "the hand fell off"
    page.do("grasp")
    with pytest.raises(
        AssertionError,
        match=r"Internal error.*the hand fell off|the hand fell off.*Internal error",
    ):
        page.wait()
    grasping.fails = ""
    page.do("grasp")
    page.wait()


def test_a_mesh_becomes_an_object_and_an_empty_file_is_refused(page: Page) -> None:
    assert "nothing.stl is empty" in page.upload("nothing.stl", b"")["error"]
    page.upload("..%2Fx.stl")
    page.wait()
    state = page.state
    assert state["studio"]["object"]["name"] == state["chosen"] == "bottle_5"
    assert state["upload"]["unit"] == "m"
    assert state["upload"]["file"] == "x.stl"


def test_a_mesh_of_ambiguous_unit_waits_for_a_choice_that_may_change(page: Page) -> None:
    before = page.state
    page.upload("unknown.stl")
    waiting = page.state
    assert waiting["chosen"] == before["chosen"]
    assert waiting["shown"] == before["shown"]
    assert {unit["unit"]: unit["size"] for unit in waiting["upload"]["units"]} == {
        "m": "0.9 x 0.9 x 3 m",
        "cm": "0.9 x 0.9 x 3 cm",
        "mm": "0.9 x 0.9 x 3 mm",
        "in": "2.29 x 2.29 x 7.62 cm",
    }
    assert [unit["unit"] for unit in waiting["upload"]["units"] if unit["possible"]] == ["cm", "in"]
    names = []
    sizes = []
    for unit in ("cm", "in"):
        page.do("unit", unit=unit)
        page.wait()
        state = page.state
        assert state["upload"]["unit"] == unit
        names.append(state["chosen"])
        sizes.append(max(state["studio"]["object"]["size_cm"]))
    assert sizes[1] / sizes[0] == pytest.approx(2.54, rel=0.05)
    # It took the place of the first
    assert names[0] == names[1]
    assert state["objects"].count(names[0]) == 1
    page.do("object", name="mug")
    assert page.wait()
    assert page.state["upload"] is None


def test_a_second_mesh_of_the_same_name_does_not_touch_the_first(tmp_path: pathlib.Path) -> None:
    uploads = Uploads(tmp_path, fake.objects(), fake.FakeImporter())
    first = uploads.take("model.stl", b"first")
    second = uploads.take("model.stl", b"second")
    assert first.path.read_bytes() == b"first"
    assert second.path.read_bytes() == b"second"
    assert first.view()["file"] == second.view()["file"] == "model.stl"
    with pytest.raises(CongraspError, match=r"^model\.txt is not an STL file"):
        uploads.take("model.txt", b"first")


def test_an_upload_during_a_job_is_refused(page, grasping, monkeypatch):
    begun = threading.Event()
    free = threading.Event()
    grasp = grasping.grasp

    def wait(*asked: Any) -> Any:
        begun.set()
        assert free.wait(30)
        return grasp(*asked)

    monkeypatch.setattr(grasping, "grasp", wait)
    before = page.state["upload"]
    page.do("grasp")
    assert begun.wait(30)
    for name in ("x.stl", "unknown.stl"):
        assert "Please wait" in page.upload(name)["error"]
    free.set()
    assert page.wait()
    assert page.state["upload"] == before


def test_a_motion_may_be_named_by_a_number(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        page_module, "render_episode_frames", lambda *asked: [np.zeros((2, 2, 3), np.uint8)]
    )
    page.do("grasp")
    number = int(page.wait()["made"])
    camera = {"position": [0.5, 0.5, 0.5], "target": [0.0, 0.0, 0.0], "field_of_view": 40.0}
    page.do("draw_motion", id=number, kind="png", camera=camera)
    page.wait()
    page.do("delete", id=number)
    assert str(number) not in [one["id"] for one in page.state["motions"]]


def test_resting_poses_have_thumbnails_and_edits_are_undone(page: Page) -> None:
    before = page.do("set_rest_pose", rest=1)
    assert before["studio"]["rest"]["index"] == 1
    assert before["history"]["undo"] == "resting pose"
    assert page.do("undo")["studio"]["rest"]["index"] == 0
    assert page.do("redo")["studio"]["rest"]["index"] == 1
    code, picture = page.ask("GET", "/api/rest?index=1")
    assert code == 200
    assert Image.open(io.BytesIO(picture)).size == (150, 112)
    assert picture != page.ask("GET", "/api/rest?index=0")[1]
    assert b"no resting pose 100" in page.ask("GET", "/api/rest?index=99")[1]
    assert page.do("object", name="mug")["history"]
    assert page.wait()
    assert page.do("undo")["history"] == {"undo": "", "redo": ""}  # nothing of the object before


def test_a_run_is_shown_next_to_the_studio(page: Page) -> None:
    view = page.get("/api/training?names=episode/return")
    assert list(view["curves"]) == ["episode/return"]
    assert len(view["actors"]) == 5
    played = decode(page.ask("GET", "/api/motion?id=actor:a003")[1])
    assert played.meta["object"] == "thing-3"
    assert "recordings" in page.get("/api/episodes?time=1&seconds=1")["error"]


def test_a_busy_port_and_an_open_interface_are_refused_in_one_line(page, capsys):
    with pytest.raises(CongraspError, match="--port"):
        PageServer(lambda browser: Routes({}, {}), "127.0.0.1", page.port)
    for arguments, says in (
        (["--host", "0.0.0.0"], "would be reachable from other machines"),
        (
            ["--policy", __file__, "--connect", "tcp/127.0.0.1:1"],
            "Pass one of --policy and --connect",
        ),
        (["--policy", "nowhere.safetensors"], "nowhere.safetensors"),
        (["--objects", "/nowhere"], "/nowhere"),
        (["--recordings", "/nowhere"], "/nowhere"),
    ):
        with pytest.raises(SystemExit) as end:
            main(["view", "--port", "0", *arguments])
        error = capsys.readouterr().err
        assert end.value.code == 2, error
        assert says in error, error
        assert error.count("\n") == 1, error
