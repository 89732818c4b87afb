import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from .report_study import written

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
ROWS = "document.querySelectorAll('#configurations tbody tr').length"
FIRST = "[...document.querySelectorAll('#configurations tbody tr')].map(r => r.cells[0].innerText)"


def browser_path() -> str:
    found = os.environ.get("QPMHE_BROWSER") or next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is on the path, nor QPMHE_BROWSER set")
    return found


@pytest.fixture(scope="module")
def browser():
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = browser_path()
    with sync_api.sync_playwright() as playwright:
        # Without its sandbox Chromium also starts as root, as in most containers.
        chromium = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield chromium
        chromium.close()


class Opened:
    """The report in a browser without network, and all it complained about or asked for."""

    def __init__(self, browser, file: Path, width: int, scheme: str = "light") -> None:
        self.context = browser.new_context(
            viewport={"width": width, "height": 900}, offline=True, color_scheme=scheme
        )
        self.page = self.context.new_page()
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", lambda message: self.complaints.append(message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(file.as_uri())
        self.page.wait_for_function("window.configurationTable")

    def check(self) -> None:
        assert self.complaints == []
        # The table's library loads itself from the page's own text.
        assert [url for url in self.requests if not url.startswith(("file:", "blob:"))] == []


@pytest.fixture(scope="module")
def wide(browser):
    one = Opened(browser, written(), 1280)
    yield one
    one.context.close()


@pytest.fixture
def opened(wide):
    """The report as it is first seen."""
    wide.page.click("#all")
    wide.page.fill("#table input[type=search]", "")
    wide.page.select_option("#case", "batch-reactor-N-10")
    yield wide
    wide.check()


def test_it_is_dark_where_the_reader_wants_that(browser):
    light, dark = (Opened(browser, written(), 390, scheme) for scheme in ("light", "dark"))
    shades = [
        [max(map(int, one.page.evaluate(
            f"getComputedStyle(document.querySelector({place!r})).backgroundColor"
        ).removeprefix("rgb(").rstrip(")").split(",")))
         for place in ("body", "#filters", "#configurations td", "select")]
        for one in (light, dark)
    ]
    assert min(shades[0]) > 200
    assert max(shades[1]) < 70
    assert dark.page.evaluate("document.documentElement.scrollWidth") <= 390
    for one in (light, dark):
        one.check()
        one.context.close()


def points(page) -> int:
    return page.evaluate(
        "document.querySelectorAll('.plot[data-figure=accuracy] .scatterlayer .point').length"
    )


def test_a_filter_and_another_problem_change_table_and_figures(opened):
    page = opened.page
    assert page.evaluate(ROWS) == 7
    assert "daqp" in page.evaluate(FIRST)
    before = points(page)
    page.click("button.backend[data-backend=daqp]")
    assert page.evaluate(ROWS) == 5
    assert "daqp" not in page.evaluate(FIRST)
    assert points(page) == before - 2
    page.click("#none")
    assert page.inner_text("#configurations tbody") == "no configuration passes the filters"
    page.click("#all")
    assert page.evaluate(ROWS) == 7
    page.select_option("#case", "batch-reactor-N-4")
    assert page.evaluate(ROWS) == 3
    visible = page.locator("dl.answers:visible")
    assert (visible.count(), visible.get_attribute("data-case")) == (1, "batch-reactor-N-4")


def test_search_and_numeric_order(opened):
    page = opened.page
    page.fill("#table input[type=search]", "osqp")
    assert page.evaluate(ROWS) == 2
    page.fill("#table input[type=search]", "")
    titles = page.evaluate("window.configurationTable.columns().titles().toArray()")
    place = titles.index("J / converged")
    page.evaluate("() => { window.configurationTable.one('draw', () => { window.drawn = 1; }); }")
    head = page.locator("#table thead th", has_text=titles[place])
    head.locator(".dt-column-title").first.click()
    page.wait_for_function("window.drawn")  # by a task of its own, after the click
    order = "{search: 'applied', order: 'applied'}"
    shown = page.evaluate(f"window.configurationTable.column({place}, {order}).data().toArray()")
    assert shown == sorted(shown)
    assert max(shown) > 10 > 1.5 > min(shown)  # as texts, 10 would come before 2


def test_what_decides_is_in_sight_and_the_rest_is_pointed_at(opened):
    page = opened.page
    section, more = page.locator("#table"), page.locator("#further")
    body = "document.querySelector('#table .dt-scroll-body')"
    right = page.evaluate(f"{body}.getBoundingClientRect().right")
    for heading in ("RMSE", "J / converged", "failed runs", "failed steps (%)", "fallback (%)"):
        head = section.locator("thead th", has=page.get_by_text(heading, exact=True)).first
        box = head.bounding_box()
        assert box["x"] + box["width"] <= right, heading
    first = section.locator("tbody tr").first.locator("td").first
    place = first.bounding_box()["x"]
    for _ in range(10):
        if more.is_visible():
            more.click()
            page.wait_for_function("document.getElementById('table').matches('.scrolled')")
    page.wait_for_function("!document.getElementById('table').matches('.more')")
    assert first.bounding_box()["x"] == place
    page.evaluate(f"{body}.scrollLeft = 0")
    page.wait_for_function("document.getElementById('table').matches('.more:not(.scrolled)')")


def test_each_figure_is_drawn_and_its_menus_work(opened):
    page = opened.page
    for name in ("accuracy", "anytime", "times", "profile", "trajectories"):
        assert page.locator(f".plot[data-figure={name}] svg.main-svg").count() > 0, name
    for menu in page.locator("select[data-figure]:visible").all():
        for value in menu.locator("option").evaluate_all("all => all.map(one => one.value)"):
            menu.select_option(value)
    run = page.locator("select[data-key=run]")
    line = "document.querySelector('.plot[data-figure=trajectories]').data[2].y.bdata"
    seen = set()
    for value in run.locator("option").evaluate_all("all => all.map(one => one.value)"):
        run.select_option(value)
        seen.add(page.evaluate(line))
    assert len(seen) > 1


def test_the_whole_page_has_ink_and_no_overflow(wide, tmp_path):
    assert wide.page.evaluate("document.documentElement.scrollWidth") <= 1280
    folder = Path(os.environ.get("QPMHE_SCREENSHOTS", tmp_path))
    folder.mkdir(parents=True, exist_ok=True)
    wide.page.screenshot(path=folder / "report.png", full_page=True)
    picture = imread(folder / "report.png")[..., :3]
    assert picture.shape[0] > 2000
    assert picture.std() > 0.05
    # The observer's vermilion.
    assert np.abs(picture - np.array([0xD5, 0x5E, 0x00]) / 255).max(axis=-1).min() < 0.02
