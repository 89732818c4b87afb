"""The studies behind docs/how-to-choose.md run, and its figures are what they say they are."""

import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from qpmhe.studies import Store

pytest.importorskip("matplotlib")
pytest.importorskip("pandas")

ROOT = Path(__file__).parents[2]
FOLDER, PAGE = ROOT / "examples" / "studies", ROOT / "docs" / "how-to-choose.md"
MARKED = re.compile(r"<!-- choose:([\w-]+) -->\n(.*?)<!-- end -->", re.DOTALL)
ZOO = ("batch_reactor",)


@pytest.fixture(scope="module", autouse=True)
def path():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(FOLDER)
        yield


def run(folder):
    import choice_page

    arguments = {
        "--seeds": 1, "--steps": 8, "--models": "batch_reactor", "--jobs": 1,
        "--store": folder / "choice.sqlite", "--page": folder / "page.md", "--pictures": folder,
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["", *(str(x) for pair in arguments.items() for x in pair)])
        choice_page.main()
    return (folder / "page.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_page_is_filled_from_cells_that_are_run_once(tmp_path):
    from choice_studies import studies
    from choice_tables import Figures

    shutil.copy(PAGE, tmp_path / "page.md")
    before, page = PAGE.read_text(encoding="utf-8"), run(tmp_path)
    assert MARKED.sub("", page) == MARKED.sub("", before)
    tables = dict(MARKED.findall(page))
    assert tables.keys() == dict(MARKED.findall(before)).keys()
    for name in ("at-all", "priors", "horizons", "caps", "starts"):
        rows = re.findall(r"^\| `(\w+)` \|", tables[name], flags=re.MULTILINE)
        assert tuple(rows) == ZOO
    for name in ("horizons", "observers"):
        assert (tmp_path / f"choose-{name}.png").stat().st_size > 5000
    frame = Store(tmp_path / "choice.sqlite").frame()
    assert (frame["outcome"] == "done").all()
    run(tmp_path)
    again = Store(tmp_path / "choice.sqlite").frame()
    assert again["finished"].tolist() == frame["finished"].tolist()
    # Errors are geometric means of ratios of the states' errors.
    figures = Figures(frame, studies(1, 8, ZOO).values())
    (row,), (base,) = (figures.cells("batch_reactor", caps).values() for caps in (0, None))
    ratios = np.array(row.rmse_states) / base.rmse_states
    assert figures.error("batch_reactor", 0) == pytest.approx(np.sqrt(ratios.prod()), rel=1e-12)


def test_the_backends_are_those_of_the_comparison():
    from choice_tables import backends

    table = backends(ROOT / "docs" / "comparison.md")
    assert len(table.splitlines()) >= 5
    # Renewed by examples/studies/choice_page.py where this fails.
    assert table in PAGE.read_text(encoding="utf-8")
