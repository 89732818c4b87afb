"""The notebooks run in a kernel of their own and print what they hold."""

import copy
import warnings
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat", reason="needs nbformat, nbclient and ipykernel")
nbclient = pytest.importorskip("nbclient", reason="needs nbformat, nbclient and ipykernel")
pytest.importorskip("ipykernel", reason="needs nbformat, nbclient and ipykernel")
pytest.importorskip("pandas", reason="the comparison needs pandas")

from test_docs import same  # noqa: E402

FOLDER = Path(__file__).parents[2] / "examples" / "notebooks"
NOTEBOOKS = sorted(path.name for path in FOLDER.glob("*.ipynb"))


def read(name):
    return nbformat.read(FOLDER / name, as_version=4)


def texts(cell):
    """What a cell printed or showed in words; addresses and pictures left out."""
    found = []
    for output in cell.get("outputs", []):
        if output["output_type"] == "stream":
            found.append(output["text"])
        elif "image/png" not in output.get("data", {}):
            found.append(output["data"]["text/plain"])
    return "\n".join(found)


def pictures(notebook):
    return sum(
        "image/png" in output.get("data", {})
        for cell in notebook.cells for output in cell.get("outputs", [])
    )


def test_there_are_both():
    assert NOTEBOOKS == ["comparison.ipynb", "quickstart.ipynb"]


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_outputs_are_kept_and_are_small(name):
    notebook = read(name)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert pictures(notebook) >= 1
    assert (FOLDER / name).stat().st_size < 400_000


@pytest.mark.slow
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_runs_and_shows_the_same(name, tmp_path):
    kept = read(name)
    found = copy.deepcopy(kept)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the client's event loop and sockets
        nbclient.NotebookClient(
            found, timeout=120, kernel_name="python3",
            resources={"metadata": {"path": str(tmp_path)}},
        ).execute()
    for before, after in zip(kept.cells, found.cells, strict=True):
        assert same(texts(after), texts(before)), texts(after)
    assert pictures(found) == pictures(kept)
