"""Grasps on README and gallery: each command gives what its page says."""

import json
import os
import pathlib
import re
import shlex
import subprocess
import sys
from typing import NamedTuple

import numpy as np
import pytest

from congrasp.common.episode.motion_file import load_motion
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import policy_file
from congrasp.common.rotations import rotate
from congrasp.services.cli.main import load
from congrasp.services.grasp.files import MOTION, RESULT

ROOT = pathlib.Path(__file__).resolve().parents[2]
README = ROOT / "README.md"
GALLERY = ROOT / "docs" / "gallery" / "index.md"
ROW = re.compile(r"`congrasp (grasp [^`]*)`<br>(\d+) of (\d+)(?:, resting pose (\d+))?")
LINE = re.compile(r"^congrasp (grasp .*)$", re.M)
POLICY = re.compile(r"`(\w+)` ([0-9a-f]{16})\b")
CHEAP = "drill:2"
"""Object of the grasp that every run of the tests repeats."""
OTHER_PROCESSORS = 2
"""Attempts by which processors with other roundings may differ."""
TEST_COMPILER = ("XLA_FLAGS", "JAX_DISABLE_MOST_OPTIMIZATIONS")
UPRIGHT = np.cos(np.radians(5.0))


class Claim(NamedTuple):
    """A command of a page, and what the page says about its grasp."""

    words: tuple[str, ...]
    held: int | None = None
    """Number of attempts that hold the object; None if the page names none."""
    attempts: int = 16
    rest: int | None = None
    """Resting pose, from 1 on; None if the page names none."""

    @property
    def same_grasp(self):
        """The words without those of pictures and videos."""
        return frozenset(self.words) - {"--video"}


def gallery_claims():
    claims = []
    for words, held, attempts, rest in ROW.findall(GALLERY.read_text()):
        number = int(rest) if rest else None
        claims.append(Claim(tuple(shlex.split(words)), int(held), int(attempts), number))
    return claims


def readme_claims():
    """Commands of README, with the claims of the gallery for the same grasp."""
    gallery = {claim.same_grasp: claim for claim in gallery_claims()}
    claims = []
    for line in LINE.findall(README.read_text()):
        claim = Claim(tuple(shlex.split(line, comments=True)))
        claims.append(gallery.get(claim.same_grasp, claim))
    return claims


def cases():
    claims = dict.fromkeys([*readme_claims(), *gallery_claims()])
    for claim in claims:
        marks = () if CHEAP in claim.words else pytest.mark.slow
        yield pytest.param(claim, id=" ".join(claim.words), marks=marks)


def missing_files(claim):
    """Files and folders of a command that the repository does not contain: scans, other grasps."""
    paths = [word for word in claim.words if word.startswith(("object_sim/", "runs/"))]
    return [path for path in paths if not (ROOT / path).exists()]


def test_pages_have_claims():
    assert len(gallery_claims()) == GALLERY.read_text().count(".jpg)")
    assert len(readme_claims()) == 4
    assert any(claim.held for claim in readme_claims()), "the filmed command is in the gallery"


@pytest.mark.parametrize("claim", gallery_claims(), ids=lambda claim: claim.words[1])
def test_gallery_command_parses(claim):
    load("grasp")(list(claim.words[1:]))


def test_gallery_policies_ship():
    hashes = dict(POLICY.findall(GALLERY.read_text()))
    assert set(hashes) == {"human", "allegro", "sharpa"}
    for hand, digest in hashes.items():
        assert bundles.load(policy_file(None, hand)).actor_sha256.startswith(digest), hand


@pytest.mark.parametrize("claim", cases())
def test_page_grasp_is_as_claimed(claim, tmp_path):
    if missing := missing_files(claim):
        pytest.skip(f"needs {missing[0]}")
    words = [word for word in claim.words if word != "--video"]
    command = [sys.executable, "-m", "congrasp", *words, "--out", str(tmp_path), "--no-pictures"]
    # Programs as users have them: the tests' own compile faster and round differently.
    environment = {k: v for k, v in os.environ.items() if k not in TEST_COMPILER}
    subprocess.run(command, cwd=ROOT, env=environment, check=True, timeout=900)
    (path,) = tmp_path.glob(f"*/{RESULT}")
    facts = json.loads(path.read_text())
    assert facts["success"]
    if claim.held is not None:
        assert facts["attempts"] == claim.attempts
        assert abs(facts["attempts_held"] - claim.held) <= OTHER_PROCESSORS
    if claim.rest is not None:
        assert facts["rest"] == claim.rest
    if "upright" in claim.words:
        start = load_motion(path.parent / MOTION).object_quaternion[0]
        assert rotate(start, np.array([0.0, 0.0, 1.0]))[2] > UPRIGHT
