import json

import pytest

from congrasp.common.task.sampling.set_file import load as load_set
from congrasp.services.assets.captures.report import Report
from congrasp.services.cli.main import load


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory):
    """Imports of meshes are remembered for these tests alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def run_import(tmp_path):
    """Runs `congrasp constraints import`; returns sets by object, and the report."""

    def run(kind, path, *options, code=0):
        out = tmp_path / "out"
        folders = ["--out", str(out), "--objects", str(tmp_path / "objects")]
        assert (
            load("constraints")(["import", kind, str(path), *folders, *map(str, options)])() == code
        )
        sets = {file.name.split(".")[0]: load_set(file) for file in out.glob("*.safetensors")}
        rows = json.loads((out / "import.json").read_text())
        return sets, Report(rows["kept"], rows["dropped"])

    return run
