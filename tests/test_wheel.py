"""What is installed: one import name, whatever folders the program around it has."""

import pathlib
import shutil
import stat
import subprocess
import sys
import zipfile

import pytest

ROOT = pathlib.Path(__file__).parents[1]
FOLDERS = ("common", "actors", "learner", "services")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> pathlib.Path:
    """The wheel of the working tree."""
    source = tmp_path_factory.mktemp("source")
    target = tmp_path_factory.mktemp("wheel")
    for folder in ("congrasp", *FOLDERS):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / folder, source / folder, symlinks=True, ignore=ignored)
    for file in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / file, source)
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "--wheel-dir",
        str(target),
        str(source),
    ]
    subprocess.run(command, check=True, timeout=300)
    return next(target.glob("*.whl"))


def test_a_wheel_installs_one_name_and_all_its_files(wheel):
    files = zipfile.ZipFile(wheel).infolist()
    assert not [file for file in files if stat.S_ISLNK(file.external_attr >> 16)]
    names = [file.filename for file in files if ".dist-info/" not in file.filename]
    assert {name.partition("/")[0] for name in names} == {"congrasp"}
    for folder in FOLDERS:
        tracked = subprocess.run(
            ["git", "ls-files", folder], cwd=ROOT, capture_output=True, text=True, check=True
        )
        assert {f"congrasp/{name}" for name in tracked.stdout.split()} <= set(names)


def test_a_program_may_have_folders_of_the_same_names(wheel, tmp_path):
    installed = tmp_path / "installed"
    program = tmp_path / "program"
    zipfile.ZipFile(wheel).extractall(installed)
    for folder in FOLDERS:
        (program / folder).mkdir(parents=True)
        (program / folder / "__init__.py").write_text(
            "raise ImportError('the module of another program')"
        )
    options = {
        "env": {"PYTHONPATH": str(installed)},
        "capture_output": True,
        "text": True,
        "timeout": 60,
    }
    code = "import congrasp; congrasp.PolicyClient, congrasp.Guard; print(congrasp.__file__)"
    for command, printed in (
        (["-c", code], str(installed)),
        (["-m", "congrasp", "--help"], "congrasp train"),
    ):
        done = subprocess.run([sys.executable, *command], cwd=program, **options)
        assert done.returncode == 0, done.stderr
        assert printed in done.stdout, done.stderr
