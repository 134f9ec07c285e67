"""Policies of an index: a local server, files, and what must not be stored."""

import contextlib
import hashlib
import http.server
import json
import pathlib
import shutil
import threading
import time

import pytest

from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.policy.pretrained import (
    SUFFIX,
    named_policy,
    packaged_file,
    policy_file,
    stored_file,
)
from congrasp.common.transport.ports import free_port
from congrasp.services.assets.policies import index
from congrasp.services.cli import main

NAME = "human-2300"
CONTENT = packaged_file("human-student").read_bytes()
PAGE = pathlib.Path(__file__).resolve().parents[3] / "docs" / "policies.md"


class Handler(http.server.BaseHTTPRequestHandler):
    """Answers by the path, as good and bad hosts do."""

    def log_message(self, *arguments):
        """Prints nothing."""

    def do_GET(self):
        content = self.server.files.get(self.path)
        if self.path == "/elsewhere":
            self.send_response(302)
            self.send_header("Location", self.server.location)
            self.end_headers()
        elif content is None:
            self.send_error(404)
        else:
            self.send_response(200)
            length = len(content) + self.server.missing
            if self.path == self.server.chunked:
                self.send_header("Transfer-Encoding", "chunked")
                content = b"100000\r\n" + content[:1000]
            else:
                self.send_header("Content-Length", str(length))
            self.end_headers()
            self.server.send(self.wfile, content)


def send_all(file, content):
    file.write(content)


def send_slowly(file, content):
    with contextlib.suppress(OSError):
        for start in range(len(content)):
            file.write(content[start : start + 1])
            file.flush()
            time.sleep(0.05)


@pytest.fixture
def server():
    host = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    host.files = {}
    host.location = ""
    host.missing = 0
    host.chunked = ""
    host.send = send_all
    thread = threading.Thread(target=host.serve_forever, daemon=True)
    thread.start()
    yield host
    host.shutdown()
    host.server_close()
    thread.join(10.0)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("CONGRASP_POLICIES", str(tmp_path / "stored"))
    monkeypatch.delenv(index.VARIABLE, raising=False)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "stored"


def entry(**changes):
    fields = {
        "address": f"{NAME}.safetensors",
        "sha256": hashlib.sha256(CONTENT).hexdigest(),
        "bytes": len(CONTENT),
        "description": "Human hand",
    }
    return {**fields, **changes}


def written(content=CONTENT, **changes):
    """Index in the working directory, next to its policy."""
    pathlib.Path("policies.json").write_text(json.dumps({"policies": {NAME: entry(**changes)}}))
    pathlib.Path(f"{NAME}.safetensors").write_bytes(content)
    return "policies.json"


def served(server, content=CONTENT, **changes):
    """Address of an index, next to its policy."""
    text = json.dumps({"policies": {NAME: entry(**changes)}})
    server.files["/v1/policies.json"] = text.encode()
    server.files[f"/v1/{NAME}.safetensors"] = content
    return f"http://127.0.0.1:{server.server_port}/v1/policies.json"


def get(*words):
    return main.run(["policies", "get", NAME, *map(str, words)])


def refused(kind, match, *words):
    """Checks that a download fails in one line, and stores nothing."""
    with pytest.raises(kind, match=match) as caught:
        get(*words)
    assert "\n" not in str(caught.value)
    assert not stored_file(NAME).exists()
    return caught.value


def test_a_policy_is_downloaded_once_and_found_by_its_name(server, capsys):
    source = served(server)
    assert get("--index", source) == 0
    assert stored_file(NAME).read_bytes() == CONTENT
    assert policy_file(pathlib.Path(NAME)) == named_policy(NAME) == stored_file(NAME)
    del server.files[f"/v1/{NAME}.safetensors"]
    assert get("--index", source) == 0
    assert "up to date" in capsys.readouterr().out


def test_commands_of_the_page_run(capsys):
    written()
    lines = [line.partition("#")[0].split() for line in PAGE.read_text().splitlines()]
    commands = [words[1:] for words in lines if words[:2] == ["congrasp", "policies"]]
    # tests/common/test_policy_average.py runs the third
    assert [words[1] for words in commands] == ["list", "get", "average"]
    for words in commands[:2]:
        assert main.run(words) == 0
    assert str(stored_file(NAME)) in capsys.readouterr().out


def test_an_index_in_the_environment_is_read(monkeypatch):
    monkeypatch.setenv(index.VARIABLE, written())
    assert get() == 0
    assert stored_file(NAME).exists()


def test_list_has_packaged_downloaded_and_available_policies(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    source = written()
    stored_file("mine").parent.mkdir()
    shutil.copy(packaged_file("human"), stored_file("mine"))
    assert main.run(["policies", "list", "--index", source]) == 0
    printed = capsys.readouterr().out
    for name, place in (("allegro-camera", "package"), ("mine", "downloaded"), (NAME, "index")):
        (line,) = [line for line in printed.splitlines() if f" {name} " in line]
        assert f" {place} " in line
    assert "reference" not in printed


def test_list_without_a_connection_has_the_local_policies(capsys):
    address = f"http://127.0.0.1:{free_port()}/policies.json"
    with pytest.raises(TransportError, match=rf"{address} cannot be reached: .*refused"):
        main.run(["policies", "list", "--index", address])
    assert "human-student" in capsys.readouterr().out


def test_content_with_another_hash_is_refused(server):
    changed = bytes([CONTENT[0] ^ 1]) + CONTENT[1:]
    for source in (served(server, changed), written(changed)):
        refused(CongraspError, "SHA-256 [0-9a-f]{64}, but the index has", "--index", source)


def test_an_earlier_file_survives_a_failed_download(server):
    source = served(server, CONTENT[:-1])
    server.missing = 1
    stored_file(NAME).parent.mkdir()
    stored_file(NAME).write_bytes(b"earlier")
    with pytest.raises(TransportError, match="ended early"):
        get("--index", source)
    assert stored_file(NAME).read_bytes() == b"earlier"
    assert [path.name for path in stored_file(NAME).parent.iterdir()] == [stored_file(NAME).name]


@pytest.mark.parametrize("content", [CONTENT + b"x", CONTENT * 3])
def test_content_larger_than_in_the_index_is_refused(server, content):
    refused(CongraspError, "is larger than", "--index", served(server, content))


def test_a_policy_above_the_limit_is_refused(server):
    refused(CongraspError, "Raise --limit", "--index", served(server), "--limit", "0.1")


def test_a_host_that_sends_slowly_meets_the_deadline(server):
    source = served(server)
    server.send = send_slowly
    text = "did not send everything in time.*--timeout"
    refused(TransportError, text, "--index", source, "--timeout", "0.5")


def test_a_policy_of_the_package_needs_no_download():
    with pytest.raises(CongraspError, match=r"no policy 'human'.*part of the package"):
        main.run(["policies", "get", "human", "--index", written()])


def test_an_interrupted_chunked_answer_ended_early(server):
    source = served(server)
    server.chunked = f"/v1/{NAME}{SUFFIX}"
    refused(TransportError, "ended early", "--index", source)


def test_a_missing_file_is_named_with_the_host_s_answer(server):
    source = served(server, address="absent.safetensors")
    refused(TransportError, "absent.safetensors answers 404", "--index", source)


def test_redirections_reach_the_web_alone(server, tmp_path):
    source = served(server, address="/elsewhere")
    server.location = f"/v1/{NAME}.safetensors"
    assert get("--index", source) == 0
    stored_file(NAME).unlink()
    secret = tmp_path / "secret"
    secret.write_bytes(CONTENT)
    server.location = secret.as_uri()
    refused(TransportError, "elsewhere", "--index", source)


@pytest.mark.parametrize("address", ["file:///etc/hostname", "ftp://example.org/x"])
def test_an_index_from_the_web_refers_to_the_web_alone(server, address):
    refused(CongraspError, "refers to", "--index", served(server, address=address))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        '{"policies": []}',
        '{"policies": {"../x": {"address": "a", "sha256": "' + "0" * 64 + '", "bytes": 1}}}',
        json.dumps({"policies": {NAME: entry(sha256="0")}}),
        json.dumps({"policies": {NAME: entry(bytes="1")}}),
        json.dumps({"policies": {NAME: {}}}),
        "[" * 100_000,
    ],
)
def test_a_file_that_is_no_index_is_named(text):
    pathlib.Path("policies.json").write_text(text)
    refused(CongraspError, "policies.json is not an index", "--index", "policies.json")


def test_an_unknown_name_has_a_suggestion():
    source = written()
    with pytest.raises(CongraspError, match=f"Did you mean '{NAME}'"):
        main.run(["policies", "get", "human-230", "--index", source])


def test_the_index_of_the_release_names_the_remedy_if_it_is_empty():
    if not index.read_index(index.index_source(), 1.0):
        refused(CongraspError, f"no policy '{NAME}'.*has none.*--index.*{index.VARIABLE}")


def test_a_policy_of_the_package_is_not_replaced(capsys):
    file = packaged_file("human")
    same = {"human": entry(sha256=hashlib.sha256(file.read_bytes()).hexdigest())}
    pathlib.Path("same.json").write_text(json.dumps({"policies": same}))
    assert main.run(["policies", "get", "human", "--index", "same.json"]) == 0
    assert "part of the package" in capsys.readouterr().out
    written()
    pathlib.Path("other.json").write_text(json.dumps({"policies": {"human": entry()}}))
    with pytest.raises(CongraspError, match=r"another policy with the name 'human'.*--out"):
        main.run(["policies", "get", "human", "--index", "other.json"])
    assert main.run(["policies", "get", "human", "--index", "other.json", "--out", "new"]) == 0
    assert pathlib.Path("new").read_bytes() == CONTENT


def test_a_release_prints_the_index_of_its_policies(capsys, tmp_path):
    index.main([str(packaged_file("human")), "--base", "https://example.org/v1/"])
    source = tmp_path / "made.json"
    source.write_text(capsys.readouterr().out)
    (made,) = index.read_index(str(source), 1.0).values()
    assert made.name == "human" and made.address == "https://example.org/v1/human.safetensors"
    assert index.has_content(packaged_file("human"), made.sha256)
