"""The pages show every example, with small pictures, and the notebooks print what they hold."""

import copy
import re
import warnings
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat", reason="needs nbformat, nbclient and ipykernel")
nbclient = pytest.importorskip("nbclient", reason="needs nbformat, nbclient and ipykernel")
pytest.importorskip("ipykernel", reason="needs nbformat, nbclient and ipykernel")
pytest.importorskip("pandas", reason="the comparison needs pandas")

from tests.test_docs import same  # noqa: E402 - behind what it needs

ROOT = Path(__file__).parents[2]
DOCS, EXAMPLES = ROOT / "docs", ROOT / "examples"
PAGE = (DOCS / "examples.md").read_text(encoding="utf-8")
NOTEBOOKS = sorted(path.name for path in EXAMPLES.glob("notebooks/*.ipynb"))
FOLDERS = sorted(path.parent.name for path in EXAMPLES.glob("gallery/*/__main__.py"))


def test_every_example_is_shown_with_a_command_and_a_picture():
    names = [path.name for path in EXAMPLES.glob("*.py")] + [f"notebooks/{n}" for n in NOTEBOOKS]
    assert [name for name in names if f"examples/{name}" not in PAGE] == []
    for section in PAGE.split("\n## ")[1:]:
        commands = re.search(r"^```sh\n(.*?)^```$", section, flags=re.MULTILINE | re.DOTALL)[1]
        for program in re.findall(r"examples/([\w/.]+)", commands):
            assert (EXAMPLES / program).is_file(), program
        (picture,) = re.findall(r"^!\[.+\]\((img/[\w-]+\.png)\)$", section, flags=re.MULTILINE)
        # Those of docs/img/gallery.py; others have pages of their own.
        most = 150_000 if not picture.startswith("img/benchmark") else 10**9
        assert (DOCS / picture).stat().st_size <= most


def test_every_page_of_the_gallery_has_its_command_and_its_line():
    make = (ROOT / "Makefile").read_text(encoding="utf-8")
    index = (DOCS / "gallery" / "index.md").read_text(encoding="utf-8")
    assert [name for name in FOLDERS if f"-m examples.gallery.{name} " not in make] == []
    for path in DOCS.glob("gallery/*.md"):
        if path.stem == "index":
            continue
        assert path.stem in FOLDERS
        text = path.read_text(encoding="utf-8")
        assert f"python -m examples.gallery.{path.stem} " in text
        assert f"]({path.name})" in index
        for picture in re.findall(r"^!\[.+\]\((.+\.png)\)$", text, flags=re.MULTILINE):
            assert (path.parent / picture).stat().st_size <= 150_000


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


@pytest.mark.slow
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs_and_shows_what_it_holds(name, tmp_path):
    kept = nbformat.read(EXAMPLES / "notebooks" / name, as_version=4)
    nbformat.validate(kept)
    code = [cell for cell in kept.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    found = copy.deepcopy(kept)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the client's event loop and sockets
        nbclient.NotebookClient(
            found, timeout=120, kernel_name="python3",
            resources={"metadata": {"path": str(tmp_path)}},
        ).execute()
    for before, after in zip(kept.cells, found.cells, strict=True):
        assert same(texts(after), texts(before)), texts(after)
    assert pictures(found) == pictures(kept) >= 1
