"""The distribution: one import name, whatever folders the program around it has; metadata; types
for programs that use it.
"""

import email.parser
import os
import pathlib
import re
import shutil
import stat
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile

import pytest

import congrasp

ROOT = pathlib.Path(__file__).parents[1]
FOLDERS = ("common", "actors", "learner", "services")
ADDRESS = "https://example.org/congrasp"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> pathlib.Path:
    """The wheel of the working tree, without the symbolic links of `congrasp/`."""
    source = tmp_path_factory.mktemp("source")
    target = tmp_path_factory.mktemp("wheel")
    for folder in ("congrasp", *FOLDERS):
        ignored = shutil.ignore_patterns("__pycache__", *FOLDERS)
        shutil.copytree(ROOT / folder, source / folder, symlinks=True, ignore=ignored)
    for file in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
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
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CONGRASP_REPOSITORY", ADDRESS)
        subprocess.run(command, check=True, timeout=400)
    return next(target.glob("*.whl"))


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory) -> pathlib.Path:
    """Python of an environment with the wheel, and with the libraries of this environment."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder)
    python = folder / "bin" / "python"
    (site,) = folder.glob("lib/*/site-packages")
    zipfile.ZipFile(wheel).extractall(site)
    (site / "libraries.pth").write_text(f"{sysconfig.get_paths()['purelib']}\n")
    return python


def type_check(python: pathlib.Path, folder: pathlib.Path) -> subprocess.CompletedProcess[str]:
    """Runs mypy on the programs of a folder without a configuration.

    Writing a cache takes longer than this only run gains from it.
    """
    command = [sys.executable, "-m", "mypy", "--strict", "--no-error-summary"]
    command += ["--python-executable", str(python), "--cache-dir", os.devnull]
    command += sorted(program.name for program in folder.glob("*.py"))
    return subprocess.run(command, cwd=folder, env={}, capture_output=True, text=True, timeout=400)


def test_a_wheel_installs_one_name_and_all_its_files(wheel):
    files = zipfile.ZipFile(wheel).infolist()
    assert not [file for file in files if stat.S_ISLNK(file.external_attr >> 16)]
    names = [file.filename for file in files if ".dist-info/" not in file.filename]
    assert {name.partition("/")[0] for name in names} == {"congrasp"}
    assert "congrasp/py.typed" in names
    for folder in FOLDERS:
        tracked = subprocess.run(
            ["git", "ls-files", folder], cwd=ROOT, capture_output=True, text=True, check=True
        )
        assert {f"congrasp/{name}" for name in tracked.stdout.split()} <= set(names)


def test_metadata_name_licence_authors_and_addresses(wheel):
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
        metadata = email.parser.Parser().parsestr(archive.read(name).decode())
    assert metadata["License-Expression"] == "Apache-2.0 AND MIT"
    assert metadata["Author"] == "The congrasp authors"
    assert len(metadata.get_all("License-File")) == 2
    assert "Typing :: Typed" in metadata.get_all("Classifier")
    assert f"Source, {ADDRESS}" in metadata.get_all("Project-URL")
    assert metadata["Version"] == congrasp.__version__


def test_classifiers_are_the_versions_that_are_supported():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    versions = re.findall(r"Python :: 3\.(\d+)", "\n".join(project["classifiers"]))
    first, last = re.findall(r"3\.(\d+)", project["requires-python"])
    assert [int(version) for version in versions] == list(range(int(first), int(last)))


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


def test_programs_of_users_pass_a_strict_type_check(installed, tmp_path):
    shutil.copy(ROOT / "tests" / "typed_program.py", tmp_path)
    readme = (ROOT / "README.md").read_text()
    (loop,) = re.findall(r"^```python\n(.*?)^```", readme, re.M | re.S)
    wrong = "congrasp.load_motion(3)\ncongrasp.graps('mug:7')\n"
    (tmp_path / "loop.py").write_text(loop)
    (tmp_path / "wrong.py").write_text(f"import congrasp\n{wrong}")
    done = type_check(installed, tmp_path)
    errors = re.findall(r"^([^:]+):.*\[([a-z-]+)\]$", done.stdout, re.M)
    expected = [("wrong.py", "arg-type"), ("wrong.py", "attr-defined")]
    assert errors == expected, done.stdout + done.stderr
    assert len(done.stdout.splitlines()) == len(expected), done.stdout
