"""Every Python block of the documentation runs, and prints what the page says it prints."""

import contextlib
import importlib
import io
import json
import re
import shutil
import subprocess
import sys
import types
import warnings
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

import qpmhe

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md"))
OUTPUT = 'text title="Output"'
# What depends on the versions of the solvers and on which of them are installed.
EXAMPLE = 'text title="Output, for example"'
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w])")


def fences(page):
    """(first line, info string, text) of each fenced block."""
    opened, info, found = 0, "", []
    lines = (DOCS / page).read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(lines, start=1):
        mark = re.match(r"\s*```(.*)", line)
        if mark and opened:
            found.append((opened + 1, info, "\n".join(lines[opened : number - 1])))
            opened = 0
        elif mark:
            opened, info = number, mark[1].strip()
    assert not opened, f"{page}: the block that line {opened} opens is never closed"
    return found


def same(found, expected):
    """Equal words, and numbers equal up to 2 % and one unit of the last decimal told."""
    equal = NUMBER.sub("#", found).split() == NUMBER.sub("#", expected).split()
    for one, other in zip(NUMBER.findall(found), NUMBER.findall(expected), strict=equal):
        mantissa, _, power = other.partition("e")
        decimals = len(mantissa.partition(".")[2])
        unit = 10.0 ** (int(power or 0) - decimals) if decimals else 0.0
        equal = equal and abs(float(one) - float(other)) <= 0.02 * abs(float(other)) + unit
    return equal


@pytest.fixture
def registered_backends():
    before = {entry.name for entry in qpmhe.solvers.backends()}
    yield
    for entry in qpmhe.solvers.backends():
        if entry.name not in before:
            qpmhe.solvers.unregister(entry.name)


@pytest.mark.parametrize("page", PAGES)
def test_page_runs(page, tmp_path, monkeypatch, registered_backends):
    monkeypatch.chdir(tmp_path)
    if page in ("how-to/speed.md", "tutorial.md"):  # they start with an empty cache
        monkeypatch.setenv("QPMHE_CACHE_DIR", str(tmp_path / "cache"))
        monkeypatch.delenv("QPMHE_ENGINE")
    if page == "how-to/fmu.md":
        shutil.copy(importlib.import_module("tests.adapters.fmus").fmu(), tmp_path)
    blocks = fences(page)
    # A module, so that functions of a page can be pickled as those of a script can.
    module = types.ModuleType("page_" + re.sub(r"\W", "_", page))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    np.random.seed(0)  # noqa: NPY002 - for pages that use it in spite of this rule
    for position, (line, info, text) in enumerate(blocks):
        assert info, f"{page}:{line}: name the language of this block"
        if info != "python":
            assert not info.startswith("py"), f"{page}:{line}: {info!r} would not run"
            if info in (OUTPUT, EXAMPLE):
                assert blocks[: position][-1][1] == "python"
            continue
        printed = io.StringIO()
        code = compile("\n" * (line - 1) + text, str(DOCS / page), "exec")
        with warnings.catch_warnings(), contextlib.redirect_stdout(printed):
            warnings.simplefilter("error")
            exec(code, vars(module))
        following, told = blocks[position + 1 : position + 2], ""
        if following and following[0][1] == EXAMPLE:
            continue
        if following and following[0][1] == OUTPUT:
            told = following[0][2]
        found = printed.getvalue()
        assert same(found, told), f"{page}:{line} printed\n{found}\nand the page says\n{told}"


def test_outputs_are_compared():
    for found, expected, verdict in (
        ("a 1.00 b", "a 1.01  b\n", True), ("a 1.00", "a 1.05", False), ("a 1", "b 1", False),
        ("0.3 0.4", "0.3", False), ("x1 0.001", "x1 0.000", True), ("-0.30", "0.30", False),
    ):
        assert same(found, expected) is verdict


def test_links_lead_somewhere_and_every_page_is_in_the_navigation():
    for page in PAGES:
        text = re.sub(r"```.*?```", "", (DOCS / page).read_text(encoding="utf-8"), flags=re.DOTALL)
        for target in re.findall(r"\]\(([^)\s]+)\)", text):
            link = urlsplit(target)
            if not link.scheme and link.path:
                assert (DOCS / page).parent.joinpath(link.path).is_file(), target
    nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[2]
    assert sorted(re.findall(r"([\w/-]+\.md)", nav)) == PAGES


def test_the_reference_holds_every_public_name_and_no_other():
    pages = "".join(page.read_text() for page in (DOCS / "reference").glob("*.md"))
    names = re.findall(r"^::: (qpmhe[\w.]*)$", pages, flags=re.MULTILINE)
    for name in names:
        module, _, attribute = name.rpartition(".")
        assert hasattr(importlib.import_module(module), attribute), name
    names = {name.rpartition(".")[2] for name in names}
    for module in (qpmhe, qpmhe.solvers, qpmhe.errors):
        modules = {
            name for name in module.__all__ if isinstance(getattr(module, name), types.ModuleType)
        }
        assert set(module.__all__) - modules - {"__version__"} <= names


class Built(HTMLParser):
    """What a page of the site makes a browser fetch, its formulas, and the text around its code."""

    def __init__(self, page):
        super().__init__()
        self.fetched, self.text, self.formulas, self.inside = [], "", 0, []
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        self.formulas += tag == "math"
        fetched = ("src", "srcset", "data", "poster")
        self.fetched += [value for name, value in attrs if name in fetched]
        if tag == "link":
            self.fetched.append(dict(attrs)["href"])
        if tag in ("code", "script", "style"):
            self.inside.append(tag)

    def handle_endtag(self, tag):
        if self.inside[-1:] == [tag]:
            self.inside.pop()

    def handle_data(self, data):
        if self.inside[-1:] == ["style"]:
            self.fetched += fetched_by_styles(data)
        if not self.inside:
            self.text += data


def fetched_by_styles(text):
    found = re.findall(r"""(?:url\(|@import)\s*["']?([^"')]+)""", text)
    return [target for target in found if not target.startswith("data:")]


# A command, a delimiter of arithmatex or of docstrings, or a table in another markup.
RAW = re.compile(r"\\[a-zA-Z(\[]|\$\S|:math:|\.\. math::|={6,}")


@pytest.mark.slow
def test_the_site_needs_no_network_and_leaves_no_formula_raw(tmp_path):
    pytest.importorskip("mkdocs")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    formulas = 0
    for path in tmp_path.rglob("*.html"):
        page = Built(path)
        formulas += page.formulas
        for target in page.fetched:
            assert not urlsplit(target).netloc, f"{path} fetches {target}"
        assert not RAW.search(page.text), f"{path}: {RAW.findall(page.text)}"
        assert "arithmatex" not in path.read_text(encoding="utf-8")
    assert formulas > 200
    for style in tmp_path.rglob("*.css"):
        for target in fetched_by_styles(style.read_text(encoding="utf-8")):
            assert not urlsplit(target).netloc, f"{style} fetches {target}"
            assert style.parent.joinpath(target).is_file(), f"{style} names {target}"
    sections = searched(tmp_path)
    for words, page in {
        "stiff": "how-to/stiff/", "dae": "how-to/algebraic/", "ros": "how-to/bridges/",
        "enkf": "reference/baselines/", "rts": "how-to/delay-and-time-indices/",
        "smoothing": "how-to/delay-and-time-indices/", "real time": "how-to/deadlines/",
    }.items():
        found = {where for where, each in sections.items() if set(words.split()) <= each}
        assert page in found, f"{words}: {sorted(found)}"
        # Few enough to look through.
        assert len({where.partition("#")[0] for where in found}) <= 20, words


def searched(site):
    """The words of each section of the site, as its search splits them."""
    index = json.loads((site / "search/search_index.json").read_text(encoding="utf-8"))
    separator = re.compile(index["config"]["separator"])
    return {
        one["location"]: {*separator.split(
            re.sub(r"<[^>]+>", " ", f"{one['title']} {one['text']}").lower())}
        for one in index["docs"]
    }


def test_formulas_are_split_where_they_have_space_and_a_wrong_one_stops_the_build(monkeypatch):
    exceptions = pytest.importorskip("mkdocs.exceptions")
    pytest.importorskip("math_core")
    monkeypatch.syspath_prepend(DOCS)
    mathematics = importlib.import_module("mathematics")
    for latex, parts in (
        (r"a, \quad b \qquad c", ["a,", "b", "c"]),
        (r"\{a\} \quad \frac{b \quad c}{d}", [r"\{a\}", r"\frac{b \quad c}{d}"]),
    ):
        assert mathematics.parts(latex) == parts
    page = types.SimpleNamespace(file=types.SimpleNamespace(src_uri="some/page.md"))
    text = r'<p><span class="arithmatex">\(\nothing x\)</span></p>'
    with pytest.raises(exceptions.PluginError, match=r"some/page\.md.*nothing"):
        mathematics.on_page_content(text, page)
