"""The report's page in a browser without network."""

import os
import shutil

import pytest

from .report_study import written

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
ROWS = "document.querySelectorAll('#configurations tbody tr').length"
FIRST = "[...document.querySelectorAll('#configurations tbody tr')].map(r => r.cells[0].innerText)"
POINTS = "document.querySelectorAll('.plot[data-figure=accuracy] .scatterlayer .point').length"
SHADE = "getComputedStyle(document.querySelector('body')).backgroundColor"


@pytest.fixture(scope="module")
def browser():
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = os.environ.get("QPMHE_BROWSER") or next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is on the path, nor QPMHE_BROWSER set")
    with sync_api.sync_playwright() as playwright:
        # Without its sandbox Chromium also starts as root, as in most containers.
        chromium = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield chromium
        chromium.close()


@pytest.fixture(params=["light", "dark"])
def page(browser, request):
    """The report, which must not complain, nor ask for anything."""
    context = browser.new_context(
        viewport={"width": 1280, "height": 900}, offline=True, color_scheme=request.param
    )
    page, complaints, requests = context.new_page(), [], []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda one: requests.append(one.url))
    page.goto(written().as_uri())
    page.wait_for_function("window.configurationTable")
    page.select_option("#case", "batch-reactor-N-10")
    yield page
    shade = page.evaluate(SHADE).removeprefix("rgb(").rstrip(")").split(",")
    assert (max(map(int, shade)) < 70) == (request.param == "dark")
    assert page.evaluate("document.documentElement.scrollWidth") <= 1280
    assert complaints == []
    # The table's library loads itself from the page's own text.
    assert [url for url in requests if not url.startswith(("file:", "blob:"))] == []
    context.close()


def test_filters_a_search_and_menus_change_table_and_figures(page):
    assert page.evaluate(ROWS) == 7
    assert "daqp" in page.evaluate(FIRST)
    before = page.evaluate(POINTS)
    page.click("button.backend[data-backend=daqp]")
    assert page.evaluate(ROWS) == 5
    assert "daqp" not in page.evaluate(FIRST)
    assert page.evaluate(POINTS) == before - 2
    page.click("#none")
    assert page.inner_text("#configurations tbody") == "no configuration passes the filters"
    page.click("#all")
    page.fill("#table input[type=search]", "osqp")
    assert page.evaluate(ROWS) == 2
    page.fill("#table input[type=search]", "")
    for name in ("accuracy", "anytime", "times", "profile", "trajectories"):
        assert page.locator(f".plot[data-figure={name}] svg.main-svg").count() > 0, name
    for menu in page.locator("select[data-figure]:visible").all():
        for value in menu.locator("option").evaluate_all("all => all.map(one => one.value)"):
            menu.select_option(value)
    page.select_option("#case", "batch-reactor-N-4")
    assert page.evaluate(ROWS) == 3
