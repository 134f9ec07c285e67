#!/usr/bin/env python3
"""Builds a target of the Dockerfile where no container engine runs: its steps in clean Debian roots, by chroot.

Then it starts the image's command as the image's user, runs its health check until it passes, and ends it. Needs root
on Linux, `debootstrap`, and network; Debian's Python stands in for the one of the official image.

    sudo python3 tests/deploy/replay_image.py cpu
"""

import argparse
import contextlib
import json
import os
import pathlib
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

DOCKERFILE = pathlib.Path(__file__).resolve().parents[2] / "deploy" / "Dockerfile"
RELEASE = "bookworm"
PACKAGES = "python3,python3-venv,ca-certificates"
CHROOT = shutil.which("chroot") or "/usr/sbin/chroot"
HEALTHY_SECONDS, END_SECONDS = 300.0, 5.0
NETWORK = re.compile(r"PIP_(?!FIND_LINKS).*|.*_proxy|SSL_CERT_FILE|REQUESTS_CA_BUNDLE", re.IGNORECASE)
"""Settings of this machine without which the registry cannot be reached."""


class Stage:
    """A root folder, and what the instructions so far say about the processes in it."""

    def __init__(self, root: pathlib.Path):
        self.root = root
        self.env = {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/root"}
        self.cwd, self.user = "/", "0:0"
        self.entrypoint: list[str] = []
        self.command: list[str] = []
        self.health: list[str] = []

    def copy(self, root: pathlib.Path) -> "Stage":
        """Another that goes on from this one."""
        subprocess.run(["cp", "-a", "--reflink=auto", self.root, root], check=True)
        other = Stage(root)
        other.env, other.cwd, other.user = dict(self.env), self.cwd, self.user
        other.entrypoint, other.command, other.health = self.entrypoint, self.command, self.health
        return other

    def start(self, command: list[str], extra: dict[str, str] | None = None) -> subprocess.Popen:
        """A process in the root, as the stage's user and in its folder."""
        inside = [CHROOT, f"--userspec={self.user}", str(self.root), "sh", "-c", 'cd "$0" && exec "$@"', self.cwd]
        return subprocess.Popen([*inside, *command], env={**self.env, **(extra or {})})


@contextlib.contextmanager
def running(stage: Stage) -> Iterator[None]:
    """With /proc, without which Python's processes do not work; never there when a root is copied or removed."""
    subprocess.run(["mount", "-t", "proc", "proc", stage.root / "proc"], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", stage.root / "proc"], check=True)


def instructions(text: str) -> list[tuple[str, str]]:
    """Name and rest of each instruction."""
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    joined = "\n".join(lines).replace("\\\n", " ")
    return [tuple(line.split(None, 1)) for line in joined.splitlines() if line.strip()]  # type: ignore[misc]


def needed(steps: list[tuple[str, str]], target: str) -> set[str]:
    """The stages that a target needs, itself among them."""
    uses: dict[str, set[str]] = {}
    for name, rest in steps:
        if name == "FROM":
            base, _, stage = rest.split()
            uses[stage] = {base}
        elif found := re.search(r"--from=(\S+)", rest):
            uses[stage].add(found[1])
    if target not in uses:
        sys.exit(f"There is no target '{target}'. Choose one of: {', '.join(uses)}.")
    wanted, todo = set(), {target}
    while todo:
        stage = todo.pop()
        wanted.add(stage)
        todo |= uses[stage] & uses.keys() - wanted
    return wanted


def build(dockerfile: pathlib.Path, target: str, work: pathlib.Path) -> Stage:
    """Carries out the instructions of all stages that the target needs."""
    steps = instructions(dockerfile.read_text())
    wanted, stages, stage = needed(steps, target), {}, None
    base = Stage(work / "debian")
    print(f"debootstrap {RELEASE}", flush=True)
    bootstrap = ["debootstrap", "--variant=minbase", f"--include={PACKAGES}", RELEASE, str(base.root)]
    subprocess.run(bootstrap, check=True, stdout=subprocess.DEVNULL)
    for file in ("/etc/resolv.conf", "/etc/hosts", os.environ.get("SSL_CERT_FILE", "")):
        if file and pathlib.Path(file).exists():
            shutil.copyfile(file, base.root / file[1:])
    for name, rest in steps:
        if name == "FROM":
            origin, _, own = rest.split()
            stage = None
            if own in wanted:
                stage = stages[own] = stages.get(origin, base).copy(work / own)
                print(f"FROM {rest}", flush=True)
        elif stage is not None:
            print(f"{name} {rest}", flush=True)
            carry_out(name, rest, stage, stages, dockerfile.parent.parent)
    return stages[target]


def carry_out(name: str, rest: str, stage: Stage, stages: dict[str, Stage], context: pathlib.Path) -> None:
    """One instruction."""
    if name == "RUN":
        network = {key: value for key, value in os.environ.items() if NETWORK.fullmatch(key)}
        with running(stage):
            failed = stage.start(["sh", "-c", rest], network).wait() != 0
        if failed:
            sys.exit(f"This failed: RUN {rest}")
    elif name == "COPY":
        *sources, target = [word for word in rest.split() if not word.startswith("--")]
        found = re.search(r"--from=(\S+)", rest)
        origin = stages[found[1]].root if found else context
        folder = stage.root / stage.cwd.lstrip("/")
        for source in sources:
            goal = stage.root / target.lstrip("/") if target.startswith("/") else folder / target
            if (origin / source.lstrip("/")).is_dir():
                shutil.copytree(origin / source.lstrip("/"), goal, symlinks=True, dirs_exist_ok=True)
            else:
                shutil.copy2(origin / source, goal)
    elif name == "WORKDIR":
        stage.cwd = rest
        (stage.root / rest.lstrip("/")).mkdir(parents=True, exist_ok=True)
    elif name == "ENV":
        key, value = rest.split("=", 1)
        stage.env[key] = value
    elif name == "USER":
        stage.user, stage.env["HOME"] = rest, "/home/congrasp"
    elif name == "ENTRYPOINT":
        stage.entrypoint = json.loads(rest)
    elif name == "CMD":
        stage.command = json.loads(rest)
    elif name == "HEALTHCHECK":
        stage.health = json.loads(rest[rest.index("CMD") + 3 :])
    else:
        sys.exit(f"This script does not know the instruction {name}.")


def exercise(stage: Stage) -> None:
    """Starts the image's command, waits until it is healthy, and ends it."""
    command = [*stage.entrypoint, *stage.command]
    print(f"start: {shlex.join(command)}", flush=True)
    server = stage.start(command)
    began = time.monotonic()
    while (code := stage.start(stage.health).wait()) != 0:
        if server.poll() is not None or time.monotonic() - began > HEALTHY_SECONDS:
            server.kill()
            sys.exit(f"It is not healthy: the health check ended with {code}.")
        time.sleep(1.0)
    print(f"healthy after {time.monotonic() - began:.1f} s", flush=True)
    began = time.monotonic()
    server.terminate()
    print(f"SIGTERM: ended with {server.wait(END_SECONDS)} after {time.monotonic() - began:.1f} s", flush=True)


def main() -> None:
    """Builds a target and tries its command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target", nargs="?", default="cpu")
    parser.add_argument("--mounted", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if os.geteuid() != 0 or not shutil.which("debootstrap"):
        sys.exit("This needs root and debootstrap: apt-get install debootstrap.")
    if not options.mounted:  # mounts of its own, which end with it
        os.execvp("unshare", ["unshare", "--mount", sys.executable, __file__, options.target, "--mounted"])
    with tempfile.TemporaryDirectory(dir="/var/tmp") as work:
        stage = build(DOCKERFILE, options.target, pathlib.Path(work))
        with running(stage):
            exercise(stage)


if __name__ == "__main__":
    main()
