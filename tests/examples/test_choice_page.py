"""The studies behind docs/how-to-choose.md run, and its figures are what they say they are."""

import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from qpmhe.models import batch_reactor
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


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("choice")
    shutil.copy(PAGE, folder / "page.md")
    return folder, run(folder)


@pytest.fixture(scope="module")
def figures(written):
    from choice_studies import studies
    from choice_tables import Figures

    store = Store(written[0] / "choice.sqlite")
    return Figures(store.frame(), studies(1, 8, ZOO).values())


def test_tables_and_pictures_are_written(written):
    folder, page = written
    before = PAGE.read_text(encoding="utf-8")
    assert MARKED.sub("", page) == MARKED.sub("", before)
    tables = dict(MARKED.findall(page))
    assert tables.keys() == dict(MARKED.findall(before)).keys()
    for name in ("at-all", "priors", "horizons", "caps", "starts"):
        rows = re.findall(r"^\| `(\w+)` \|", tables[name], flags=re.MULTILINE)
        assert tuple(rows) == ZOO
    for name in ("horizons", "observers"):
        assert (folder / f"choose-{name}.png").stat().st_size > 5000


def test_no_cell_fails_and_none_is_run_twice(written):
    folder, _ = written
    before = Store(folder / "choice.sqlite").frame()
    assert (before["outcome"] == "done").all()
    run(folder)
    after = Store(folder / "choice.sqlite").frame()
    assert after["finished"].tolist() == before["finished"].tolist()


def test_errors_are_geometric_means_of_ratios_of_states(figures):
    (row,) = figures.cells("batch_reactor", 0).values()
    (base,) = figures.cells("batch_reactor", None).values()
    ratios = np.array(row.rmse_states) / base.rmse_states
    assert figures.error("batch_reactor", 0) == pytest.approx(np.sqrt(ratios.prod()), rel=1e-12)
    assert figures.error("batch_reactor", None) == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize("horizon", [2, 40])
def test_one_qp_about_a_kalman_filter_with_its_prior_is_that_filter(horizon):
    from choice_models import observed

    import qpmhe

    system, observer, cost, scenario = observed("batch_reactor", "extended", "observer")
    _, measurements = scenario.simulate(0, 60)
    alone, one = (
        qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=horizon, initial_state=scenario.initial_estimate,
            max_qps=max_qps,
        ).run(measurements).states
        for max_qps in (0, 1)
    )
    np.testing.assert_allclose(one, alone, rtol=1e-8)


def test_outliers_are_in_the_measurements_alone():
    from choice_models import SHARE, SIZE, outlying

    plain, scenario = batch_reactor().scenario, outlying("batch_reactor").scenario
    states, clean = plain.simulate(3, 4000)
    again, measurements = scenario.simulate(3, 4000)
    np.testing.assert_array_equal(again, states)
    moved = np.abs(measurements - clean)
    hit = moved > 0.0
    np.testing.assert_allclose(moved[hit], SIZE * 0.2, rtol=1e-9)
    assert abs(hit.mean() - SHARE) < 0.01


def test_the_estimator_knows_the_set_that_bounds_the_disturbances():
    from choice_models import one_sided, without_states

    for known in (True, False):
        parts = one_sided("batch_reactor", known)
        states, _ = parts.scenario.simulate(0, 20)
        steps = states[1:] - parts.system.f(states[:-1], np.empty((20, 0)))
        assert (steps > -1e-12).all()
        assert (parts.system.disturbances is not None) is known
    free = without_states("cstr")
    assert free.system.states is None
    assert free.scenario.system.states is not None


def test_markers_must_be_there():
    from choice_page import filled

    assert filled("a\n<!-- choose:b -->\nc\n<!-- end -->\n", "b", "d") == (
        "a\n<!-- choose:b -->\n\nd\n\n<!-- end -->\n"
    )
    with pytest.raises(ValueError, match="'x' 0 times"):
        filled("nothing", "x", "d")


def test_the_backends_are_those_of_the_comparison():
    from choice_tables import backends

    table = backends(ROOT / "docs" / "comparison.md")
    assert len(table.splitlines()) >= 5
    # Renewed by examples/studies/choice_page.py where this fails.
    assert table in PAGE.read_text(encoding="utf-8")
