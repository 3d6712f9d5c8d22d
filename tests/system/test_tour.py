"""The notebook examples/tour.ipynb runs from top to bottom, is stored without outputs, and says what the files hold."""

import json
import os

import pytest

from support.places import ROOT
from support.synthetic import make_capture

TOUR = ROOT / "examples" / "tour.ipynb"
CELLS = json.loads(TOUR.read_text())["cells"]


@pytest.fixture
def short(monkeypatch, tmp_path):
    """A training of a few iterations on a small capture, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    capture = make_capture(tmp_path / "capture", views=9, size=(48, 32), points=250).folder
    settings = {"CAPTURE": capture, "ITERATIONS": 12, "OUT": tmp_path / "tour"}
    for name, value in settings.items():
        monkeypatch.setenv(f"SCENE_EXPERTS_TOUR_{name}", str(value))
    return tmp_path / "tour"


def test_the_notebook_is_stored_without_outputs():
    code = [cell for cell in CELLS if cell["cell_type"] == "code"]
    assert len(code) >= 5 and CELLS[0]["cell_type"] == "markdown"
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)


@pytest.mark.slow
def test_its_cells_run(short):
    pytest.importorskip("matplotlib").use("agg", force=True)
    names: dict[str, object] = {"__name__": "__main__"}
    for number, cell in enumerate(CELLS):
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"{TOUR.name}, cell {number}", "exec"), names)
    assert {"scene.compact", "scene.html", "results.json"} <= set(os.listdir(short))


@pytest.mark.slow
@pytest.mark.foreign
@pytest.mark.skipif(not os.environ.get("SCENE_EXPERTS_NOTEBOOK"), reason="set SCENE_EXPERTS_NOTEBOOK=1 and install nbclient and ipykernel")
def test_jupyter_runs_it(short, monkeypatch):
    monkeypatch.delenv("MPLBACKEND", raising=False)
    nbformat, client = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    done = client.NotebookClient(nbformat.read(TOUR, as_version=4), timeout=60, kernel_name="python3").execute()
    code = [cell for cell in done.cells if cell.cell_type == "code"]
    assert sum("image/png" in output.get("data", {}) for cell in code for output in cell.outputs) >= 4
    assert (short / "scene.html").is_file()
