"""The studies behind docs/how-to-choose.md run, and its figures are what they say they are."""

import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import qpmhe
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


def test_the_models_of_the_studies():
    from choice_models import SHARE, SIZE, observed, one_sided, outlying, without_states

    # One QP about a Kalman filter with its prior is that filter.
    system, observer, cost, scenario = observed("batch_reactor", "extended", "observer")
    y = scenario.simulate(0, 60).measurements
    alone, one = (
        qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=40, initial_state=scenario.initial_estimate,
            max_qps=max_qps,
        ).run(y).states
        for max_qps in (0, 1)
    )
    np.testing.assert_allclose(one, alone, rtol=1e-8)
    # Outliers are in the measurements alone.
    states, clean = qpmhe.models.batch_reactor().scenario.simulate(3, 4000)
    again, measurements = outlying("batch_reactor").scenario.simulate(3, 4000)
    np.testing.assert_array_equal(again, states)
    moved = np.abs(measurements - clean)
    np.testing.assert_allclose(moved[moved > 0.0], SIZE * 0.2, rtol=1e-9)
    assert abs((moved > 0.0).mean() - SHARE) < 0.01
    # An estimator that knows the set that bounds the disturbances, or not.
    for known in (True, False):
        parts = one_sided("batch_reactor", known)
        states, _ = parts.scenario.simulate(0, 20)
        assert (states[1:] - parts.system.f(states[:-1], np.empty((20, 0))) > -1e-12).all()
        assert (parts.system.disturbances is not None) is known
    free = without_states("cstr")
    assert free.system.states is None
    assert free.scenario.system.states is not None


def test_the_backends_are_those_of_the_comparison():
    from choice_tables import backends

    table = backends(ROOT / "docs" / "comparison.md")
    assert len(table.splitlines()) >= 5
    # Renewed by examples/studies/choice_page.py where this fails.
    assert table in PAGE.read_text(encoding="utf-8")
