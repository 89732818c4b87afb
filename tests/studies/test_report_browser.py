"""The report's page in a browser without network."""

import os
import shutil

import pytest

from .report_study import written

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
COLUMN = (
    "place => [...document.querySelectorAll('#configurations tbody tr:not([hidden])')]"
    ".map(row => row.cells[place].innerText)"
)
POINTS = (
    "[...document.querySelectorAll('#accuracy .plot:not([hidden]) g[data-backend]')]"
    ".filter(one => getComputedStyle(one).display !== 'none' && one.querySelector('title')).length"
)
HEADINGS = "[...document.querySelectorAll('#configurations th')].map(one => one.textContent)"
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


@pytest.fixture(params=[("light", 1280), ("dark", 390)], ids=["light", "dark and narrow"])
def page(browser, request):
    """The report, which must not complain, nor ask for anything."""
    scheme, width = request.param
    context = browser.new_context(
        viewport={"width": width, "height": 900}, offline=True, color_scheme=scheme
    )
    page, complaints, requests = context.new_page(), [], []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda one: requests.append(one.url))
    page.goto(written().as_uri())
    page.select_option("#case", "batch-reactor-N-10")
    yield page
    shade = page.evaluate(SHADE).removeprefix("rgb(").rstrip(")").split(",")
    assert (max(map(int, shade)) < 70) == (scheme == "dark")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert complaints == []
    assert [url for url in requests if not url.startswith("file:")] == []
    context.close()


@pytest.mark.slow
def test_buttons_and_the_menu_change_table_and_figures(page):
    assert len(page.evaluate(COLUMN, 0)) == 7
    assert page.evaluate(POINTS) == 7
    page.click("button.backend[data-backend=daqp]")
    assert len(page.evaluate(COLUMN, 0)) == 5
    assert "daqp" not in page.evaluate(COLUMN, 0)
    assert page.evaluate(POINTS) == 7 - 2
    page.click("#none")
    assert page.evaluate(COLUMN, 0) == []
    assert page.evaluate(POINTS) == 0
    page.click("#all")
    for name in ("accuracy", "anytime", "times", "profile", "errors", "run"):
        assert page.locator(f"#{name} .plot svg:visible").count() > 0, name
    page.select_option("#case", "batch-reactor-N-4")
    assert len(page.evaluate(COLUMN, 0)) == 3
    assert page.evaluate(POINTS) == 3


@pytest.mark.slow
def test_a_click_on_a_heading_sorts_numbers_as_numbers_and_texts_as_texts(page):
    headings = page.evaluate(HEADINGS)
    for name, read in (("time 99\u00a0% (µs)", lambda text: float(text.replace(",", ""))),
                       ("backend", str), ("cap", lambda text: (text == "none", text))):
        place = headings.index(name)
        for reverse in (False, True):
            page.locator("#configurations th button").nth(place).click()
            found = [read(text) for text in page.evaluate(COLUMN, place)]
            assert found == sorted(found, reverse=reverse)
            assert len(set(found)) > 1
