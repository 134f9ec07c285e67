"""The notebook of the examples: small, without outputs, and it runs."""

import shutil

import nbclient
import nbformat
import pytest

from tests.examples import EXAMPLES

NOTEBOOK = EXAMPLES / "grasp.ipynb"
FILES = ("mug.obj", "handle.obj")


def read_notebook():
    return nbformat.read(NOTEBOOK, as_version=4)


def test_notebook_is_short_and_has_no_outputs():
    notebook = read_notebook()
    nbformat.validate(notebook)
    assert 8 <= len(notebook.cells) <= 15
    for cell in notebook.cells:
        if cell.cell_type == "code":
            assert cell.outputs == [] and cell.execution_count is None


@pytest.mark.timeout(900)
@pytest.mark.slow
def test_notebook_runs_and_shows_pictures_and_a_motion(tmp_path, monkeypatch):
    for name in FILES:
        shutil.copy(EXAMPLES / name, tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(EXAMPLES.parent))
    # Set by commands that other tests ran in this process; a notebook shows no pictures with it.
    monkeypatch.delenv("MPLBACKEND", raising=False)
    notebook = read_notebook()
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=600, resources=resources).execute()
    outputs = []
    shown = []
    for cell in notebook.cells:
        outputs += cell.get("outputs", [])
    for output in outputs:
        shown += output.get("data", {})
    assert shown.count("image/png") == 4
    assert sum("iframe" in output.get("data", {}).get("text/html", "") for output in outputs) == 1
    assert not [output for output in outputs if output.get("name") == "stderr"]
    assert (tmp_path / "mug.npz").exists()
