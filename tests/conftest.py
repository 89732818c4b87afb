"""Which cases run: some of every test that is not slow, all, or what is left out of these.

`make test` runs the first case of every test, and in the folders of `DEEP`, which concern all
rooms, up to `CASES` of each. They are taken one by one: each is the first of those that have most
values of parameters which no case before it has; once every value is there, no more are taken.
Of tests that are marked `whole`, whose cases take less than a second together, all are taken.
Tests that are marked `slow` are left out. ``--all`` runs everything; ``--rest`` runs everything
that `make test` does not, and once more, at full length, the tests that are marked `shortened`,
which do less without ``--all``. C is compiled without optimisation, which takes a third of the
time, and both runs share the libraries; where all cases run, tests that take `as_users_compile`
optimise it.
"""

import os
import shutil
import sys
from collections import defaultdict

import hypothesis
import pytest

CASES, DEEP = 2, {"oracles", "properties"}
# Examples of each property whose test names no number: without --all, and with it.
FEW, MANY = 6, 12
# Begun first, so that no long test is the last one: most of these tests start processes.
FIRST = {"studies", "tests", "cli", "examples", "records"}
# How many cases run, and of how many.
CASES_OF = pytest.StashKey[tuple[int, int]]()


def pytest_addoption(parser):
    group = parser.getgroup("qpmhe")
    group.addoption("--all", action="store_true", help="run all cases of all tests, slow ones too")
    group.addoption("--rest", action="store_true", help="run what is left out without --all")
    group.addoption(
        "--fuzz-steps", type=int, default=0, metavar="N",
        help="random steps to compare with the second implementation (default: some hundreds)",
    )
    group.addoption("--fuzz-seed", type=int, default=1, metavar="N", help="seed of these steps")


def pytest_configure(config):
    config.option.all = config.option.all or config.option.rest
    examples = MANY if config.option.all else FEW
    hypothesis.settings.register_profile("here", max_examples=examples)
    hypothesis.settings.load_profile("here")
    # No test depends on what the user's cache holds, or on what other tests have compiled.
    os.environ.setdefault("QPMHE_CACHE_DIR", str(config.cache.mkdir("libraries")))
    os.environ.setdefault("QPMHE_ENGINE", "python")
    compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    if compiler and os.name == "posix":
        os.environ.setdefault("CC", str(unoptimized(compiler, config.cache.mkdir("compilers"))))


def unoptimized(compiler, folder):
    """A compiler whose last option is -O0, whatever comes before."""
    # The cache of libraries knows a compiler by its file, which is another one after an update.
    text = f'#!/bin/sh\n# {os.stat(compiler).st_mtime_ns}\nexec "{compiler}" "$@" -O0\n'
    path = folder / "cc"
    if not path.exists() or path.read_text("utf-8") != text:
        new = folder / f"cc.{os.getpid()}"  # processes of pytest-xdist begin together
        new.write_text(text, "utf-8")
        new.chmod(0o755)
        new.replace(path)
    return path


def named(config, item):
    """Whether the command line names this very case."""
    return any("::" in one and one.rpartition("::")[2] == item.name for one in config.args)


def values_of(item):
    """The values of a case's parameters; they are objects that all cases of a test share."""
    return {(name, id(value)) for name, value in item.callspec.params.items()}


def some(cases):
    """Some cases of one test, each with as many new values of parameters as there are."""
    most = CASES if cases[0].path.parent.name in DEEP else 1
    left, kept, seen = [(item, values_of(item)) for item in cases], [], set()
    while left and len(kept) < most:
        item, values = max(left, key=lambda one: len(one[1] - seen))
        if values <= seen:
            break
        left.remove((item, values))
        kept.append(item)
        seen |= values
    return kept


def chosen(items):
    """The cases that `make test` runs."""
    tests = defaultdict(list)
    for item in items:
        if item.get_closest_marker("slow") is None:
            tests[item.nodeid.partition("[")[0]].append(item)
    return {
        item for cases in tests.values() for item in (
            some(cases) if hasattr(cases[0], "callspec")
            and cases[0].get_closest_marker("whole") is None else cases)
    }


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    collected, kept, option = len(items), set(items), config.option
    if option.rest:
        kept -= {one for one in chosen(items) if one.get_closest_marker("shortened") is None}
    elif not option.all:
        kept = chosen(items) | {item for item in items if named(config, item)}
    config.hook.pytest_deselected(items=[item for item in items if item not in kept])
    config.stash[CASES_OF] = len(kept), collected
    kept = [item for item in items if item in kept]
    items[:] = sorted(kept, key=lambda item: item.path.parent.name not in FIRST)


def pytest_sessionfinish(session):
    if hasattr(session.config, "workeroutput"):  # a process of pytest-xdist
        session.config.workeroutput["cases"] = session.config.stash.get(CASES_OF, None)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node, error):
    cases = getattr(node, "workeroutput", {}).get("cases")
    if cases:
        node.config.stash[CASES_OF] = tuple(cases)


def pytest_report_header(config):
    if config.option.rest:
        return "cases: those that make test leaves out"
    if config.option.all:
        return "cases: all"
    return (
        f"cases: one of each test, up to {CASES} in {' and '.join(sorted(DEEP))}, none of slow "
        "ones; --all runs all, --rest the others"
    )


def pytest_terminal_summary(terminalreporter, config):
    cases = config.stash.get(CASES_OF, None)
    if cases:
        terminalreporter.write_line(f"cases: {cases[0]} of {cases[1]}")


@pytest.fixture
def as_users_compile(pytestconfig, monkeypatch):
    """C is optimised as it is for users, where all cases run."""
    ours = str(pytestconfig.cache.mkdir("compilers") / "cc")  # no compiler that the user names
    if pytestconfig.option.all and os.environ.get("CC") == ours:
        monkeypatch.delenv("CC")


@pytest.fixture(autouse=True)
def _no_figures_left():
    """Pyplot keeps the figures that it shows, and warns of too many."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")
