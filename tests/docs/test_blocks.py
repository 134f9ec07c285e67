"""Every code block of README and docs is run by a test, or a comment above it has the reason.

    <!-- run by tests/docs/test_docs.py -->      another test runs it
    <!-- not run: needs several machines -->     no test does, for this reason
    <!-- needs: bpy -->                          run here where this module can be imported

Blocks without a comment are run here, page by page, in a folder with the examples. Lines that
install are skipped: `test_pages.py` compares their extras. Commands are parsed by `test_docs.py`,
also where they are not run.
"""

import importlib.util
import json
import os
import pathlib
import re
import shlex
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest

from congrasp.common.episode.motion_file import save_motion
from congrasp.common.runtime.engines import ENGINES
from congrasp.common.task.sensors import SENSORS
from congrasp.common.transport.urls import SCHEMES
from congrasp.services.cli import main
from tests import studio
from tests.base_install import run_in_base_install, steady_server
from tests.children import python
from tests.episodes import episode

ROOT = pathlib.Path(__file__).resolve().parents[2]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "deploy/README.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
]
GENERATED = re.compile(r"<!-- results .*?<!-- end of results -->", re.S)
BLOCK = re.compile(r"((?:^<!-- [^\n]* -->\n)*)^```([^\n]*)\n(.*?)^```", re.M | re.S)
COMMENT = re.compile(r"<!-- (run by|not run:|needs:) (.*) -->")
COMMAND = re.compile(
    r"^(\$ |congrasp |python |pip |make |git |cd |sh |curl |docker |blender )", re.M
)
SERVED = {"README.md": "human"}
"""Pages with a control loop, and the hand of the server that it finds."""


class Block(NamedTuple):
    """A code block of a page."""

    page: str
    line: int
    language: str
    text: str
    comments: dict[str, str]
    """By their first words."""


def read_blocks() -> list[Block]:
    blocks = []
    for page in PAGES:
        text = GENERATED.sub(lambda match: "\n" * match[0].count("\n"), page.read_text())
        for match in BLOCK.finditer(text):
            comments, language, content = match.groups()
            if language.startswith("{"):
                continue  # a directive: the site's build runs it
            line = text[: match.start(2)].count("\n") + 1
            name = str(page.relative_to(ROOT))
            blocks.append(Block(name, line, language, content, dict(COMMENT.findall(comments))))
    return blocks


BLOCKS = read_blocks()


def name_of(block: Block) -> str:
    return f"{block.page}:{block.line}"


def is_run_here(block: Block) -> bool:
    return not block.comments and block.language != "text"


def make_motion(folder: pathlib.Path) -> None:
    save_motion(folder / "grasp.npz", episode(10, removal=6))
    studio.record(folder / "runs" / "mine", [(1_700_000_000.0, 1)])


FILES = {"docs/reference/motion-file.md": make_motion}
"""Pages whose blocks read files, and what makes these."""

NAMES = {
    "docs/extending.md": """
import pathlib
from collections.abc import Iterator
import jax.numpy as jnp
from congrasp.common.task.reward import Term
from congrasp.common.task.sensors import SENSORS
from congrasp.services.assets.captures.sequence import Dropped, Meshes, Sequence
from congrasp.common.hands.mano import ManoModel
from tests.common.own_sensor import Tactile
""",
    "docs/extending-learners.md": """
from collections.abc import Sequence
from congrasp.actors.physics.engine import Physics
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.config import TaskConfig
from congrasp.common.transport.base import Transport
""",
    "docs/policy-export.md": """
import numpy as np
from congrasp.common.policy import bundle
from congrasp.common.policy.pretrained import policy_file
from congrasp.services.export.policy_description import describe
fields = describe(bundle.load(policy_file(None, "human")))["observation"]
observation = np.zeros((1, sum(field["size"] for field in fields)), np.float32)
""",
}
"""Imports that a page's blocks take from the file that they are a part of."""


@pytest.fixture
def registries() -> Iterator[None]:
    """Registries to which blocks add rows have their own rows again after the test."""
    rows = [(registry, dict(registry)) for registry in (ENGINES, SENSORS, SCHEMES)]
    yield
    for registry, before in rows:
        registry.clear()
        registry.update(before)


def run_commands(text: str) -> None:
    for line in text.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if not words or words[:2] == ["pip", "install"]:
            continue
        assert words[0] == "congrasp", line
        assert main.run(words[1:]) == 0, line


@pytest.mark.parametrize("block", BLOCKS, ids=name_of)
def test_block_is_run_or_has_a_reason(block: Block) -> None:
    assert block.language in ("sh", "text", "python", "json"), "name the block's language"
    if block.language == "text" and not block.comments:
        assert not COMMAND.search(block.text), "mark commands as sh, or say why they are not run"
    if test := block.comments.get("run by"):
        text = (ROOT / test).read_text()
        page = pathlib.Path(block.page)
        example = re.search(r"examples/(\w+)\.py", block.text)
        assert page.stem in text or (example and example[1] in text), f"{test} does not read it"


@pytest.mark.timeout(900)
@pytest.mark.slow
@pytest.mark.parametrize("page", sorted({block.page for block in BLOCKS if is_run_here(block)}))
def test_blocks_of_a_page_run(page, tmp_path, monkeypatch, registries):
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    (tmp_path / "mug.obj").symlink_to(ROOT / "examples" / "mug.obj")
    monkeypatch.chdir(tmp_path)
    if page in FILES:
        FILES[page](tmp_path)
    names: dict[str, Any] = {"__name__": "block"}
    exec(NAMES.get(page, ""), names)
    for block in BLOCKS:
        if block.page != page or not is_run_here(block):
            continue
        if block.language == "sh":
            run_commands(block.text)
        elif block.language == "json":
            assert json.loads(block.text)
        elif page in SERVED:
            with steady_server(SERVED[page]) as port:
                code = block.text.replace("127.0.0.1:7457", f"127.0.0.1:{port}")
                done = run_in_base_install(code)
            assert done.returncode == 0, done.stderr
            assert np.fromstring(done.stdout.replace("[", "").replace("]", ""), sep=" ").size
        else:
            exec(compile(block.text, name_of(block), "exec"), names)


@pytest.mark.slow
@pytest.mark.parametrize(
    "block", [block for block in BLOCKS if "needs:" in block.comments], ids=name_of
)
def test_block_runs_where_its_module_is(block: Block, tmp_path: pathlib.Path) -> None:
    module = block.comments["needs:"]
    if importlib.util.find_spec(module) is None:
        pytest.skip(f"needs the module {module}")
    motion = tmp_path / "grasp.npz"
    save_motion(motion, episode(10, removal=6))
    out = tmp_path / "mug.glb"
    assert main.run(["export", "motion", str(motion), "--to", "glb", "--out", str(out)]) == 0
    script = tmp_path / "script.py"
    script.write_text(block.text)
    # The module may lie on a path of this process.
    done = python(script, cwd=tmp_path, env={"PYTHONPATH": os.environ.get("PYTHONPATH", "")})
    assert done.returncode == 0, done.stderr
    assert "bones, frames 0 to 9" in done.stdout
    assert (tmp_path / "mug.fbx").stat().st_size > 10_000
    assert (tmp_path / "mug.blend").stat().st_size > 10_000
