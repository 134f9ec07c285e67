"""The services of compose.yaml on hosts of their own: network namespaces on a bridge, with names
and certificates.
"""

import contextlib
import json
import os
import pathlib
import re
import shlex
import shutil
import subprocess
import sys
import time

import pytest
import yaml

from congrasp.services.record.reader import read_metrics
from tests.conftest import ROOT

SERVICES = yaml.safe_load((ROOT / "deploy" / "compose.yaml").read_text())["services"]
HOSTS = {"learner": "10.77.0.1", "actor": "10.77.0.2", "server": "10.77.0.3"}
"""The recorder is on the learner's host."""
TINY = (
    *(
        "--updates",
        "1000000",
        "--environments",
        "4",
        "--checkpoint-every",
        "3",
        "--objects.count",
        "2",
    ),
    *("--objects.families", "box", "--network.hidden", "32", "--network.encoder", "8"),
    *("--ppo.epochs", "1", "--ppo.minibatches", "2"),
)
CONGRASP = f"{shlex.quote(sys.executable)} -m services.cli.main"
pytestmark = pytest.mark.timeout(600)


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, timeout=20)


@pytest.fixture
def hosts():
    """A namespace for each host, with a name that the others know; what is needed to run a command
    there.
    """
    prefix = f"congrasp{os.getpid()}-"
    names = {host: f"{prefix}{host}" for host in (*HOSTS, "switch")}
    with contextlib.ExitStack() as stack:
        try:
            for name in names.values():
                ip("netns", "add", name)
                stack.callback(ip, "netns", "del", name)
            ip("-n", names["switch"], "link", "add", "bridge", "type", "bridge")
        except (OSError, subprocess.CalledProcessError):
            pytest.skip("network namespaces cannot be made here: that needs root and iproute2")
        ip("-n", names["switch"], "link", "set", "bridge", "up")
        for number, (host, address) in enumerate(HOSTS.items()):
            port = f"port{number}"
            name = names[host]
            ip(
                "-n",
                name,
                "link",
                "add",
                "eth0",
                "type",
                "veth",
                "peer",
                "name",
                port,
                "netns",
                names["switch"],
            )
            ip("-n", names["switch"], "link", "set", port, "master", "bridge", "up")
            ip("-n", name, "addr", "add", f"{address}/24", "dev", "eth0")
            ip("-n", name, "link", "set", "eth0", "up")
            ip("-n", name, "link", "set", "lo", "up")
            etc = pathlib.Path("/etc/netns", name)
            etc.mkdir(parents=True)
            stack.callback(shutil.rmtree, etc)
            (etc / "hosts").write_text(
                "127.0.0.1 localhost\n" + "".join(f"{a} {h}\n" for h, a in HOSTS.items())
            )
        yield {host: ["ip", "netns", "exec", names[host]] for host in HOSTS}


class Cluster:
    """The services as processes; volumes are folders."""

    def __init__(self, hosts: dict[str, list[str]], folder: pathlib.Path):
        self._hosts = hosts
        self._folder = folder
        self.processes: dict[str, subprocess.Popen[str]] = {}

    def words(self, service: str, words: list[str]) -> list[str]:
        """Command words of a service with the values of its variables and the paths of its
        volumes.
        """
        paths = {}
        for volume in SERVICES[service].get("volumes", ()):
            if isinstance(volume, str):
                volume = dict(zip(("source", "target"), volume.split(":"), strict=True))
            path = self._folder / volume["source"] / volume.get("volume", {}).get("subpath", "")
            path.mkdir(parents=True, exist_ok=True)
            paths[volume["target"]] = path
        values = [re.sub(r"\$\{\w+:-(\w+)\}", r"\1", word) for word in words]
        pattern = "(?<![^= ])(" + "|".join(paths) + ")(?=/| |$)"
        return [re.sub(pattern, lambda match: str(paths[match[1]]), word) for word in values]

    def run(self, host: str, words: list[str]) -> subprocess.CompletedProcess[str]:
        """A command on a host, to its end."""
        command = [*self._hosts[host], *words]
        return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)

    def start(self, name: str, service: str, *more: str) -> None:
        """A service on its host."""
        host = service if service in HOSTS else "learner"
        command = [
            *self._hosts[host],
            *shlex.split(CONGRASP),
            *self.words(service, SERVICES[service]["command"]),
            *more,
        ]
        with (self._folder / f"{name}.log").open("a") as log:
            self.processes[name] = subprocess.Popen(
                command, stdout=log, stderr=log, stdin=subprocess.DEVNULL
            )

    def restart_ended(self, name: str, service: str) -> None:
        """What compose's `restart: always` does."""
        if self.processes[name].poll() is not None:
            self.start(name, service)

    def logs(self) -> str:
        return "\n".join(
            f"{path.name}: {path.read_text()[-2000:]}" for path in self._folder.glob("*.log")
        )

    def end(self) -> dict[str, int]:
        """SIGTERM to all; their exit codes."""
        for process in self.processes.values():
            process.terminate()
        return {name: process.wait(20) for name, process in self.processes.items()}


@pytest.mark.slow
def test_a_run_on_three_hosts(hosts, tmp_path):
    cluster = Cluster(hosts, tmp_path)
    (script,) = cluster.words("certs", SERVICES["certs"]["command"])
    output = cluster.run("learner", ["sh", "-c", script.replace("|| congrasp", f"|| {CONGRASP}")])
    assert output.returncode == 0, output.stderr
    run_dir = tmp_path / "runs" / "quickstart"
    try:
        cluster.start("learner", "learner", *TINY)
        for number in range(2):
            cluster.start(f"actor-{number}", "actor", "--threads", "1", "--physics", "native")
        cluster.start("recorder", "recorder")
        cluster.start("server", "server")
        deadline = time.monotonic() + 400
        health = [
            *shlex.split(CONGRASP),
            *cluster.words("server", SERVICES["server"]["healthcheck"]["test"][2:]),
        ]
        while True:
            for name in ("recorder", "server"):
                cluster.restart_ended(name, name)
            trained = (run_dir / "version").exists() and int((run_dir / "version").read_text()) >= 1
            if trained and (answered := cluster.run("server", health)).returncode == 0:
                break
            assert cluster.processes["learner"].poll() is None, cluster.logs()
            assert time.monotonic() < deadline, cluster.logs()
            time.sleep(1.0)
        answer = json.loads(answered.stdout)
        assert answer["ready"]
        assert answer["hand"] == "human"
        observer = ["--certs", str(tmp_path / "certs" / "observer.0")]
        status = ["status", "--connect", "tls/learner:7447", *observer, "--json"]
        run_status = json.loads(cluster.run("actor", [*shlex.split(CONGRASP), *status]).stdout)
        roles = sorted(role["role"] for role in run_status["roles"])
        assert roles == ["actor", "actor", "learner", "recorder", "server"]
        assert run_status["warnings"] == []
        stranger = ["query", "--health", "--connect", "tls/server:7457", "--timeout", "3"]
        assert cluster.run("actor", [*shlex.split(CONGRASP), *stranger]).returncode != 0
    finally:
        codes = cluster.end()
    assert set(codes.values()) == {143}, cluster.logs()
    assert read_metrics(run_dir / "recordings"), cluster.logs()
