"""Which tests run: a sample of about five minutes, or everything with ``--all``.

The sample holds every test but those marked ``slow``. Of a test with several cases it holds one
and a share of the others: first those that bring new values of the parameters, and in `oracles`
and `properties` all of these, up to a number that seeds alone exceed. The choice depends on the
names of the cases only, so that the processes of pytest-xdist agree on it.
"""

import hashlib
import os
import sys
from collections import defaultdict

import hypothesis
import pytest

SEED = 1
# The share of the cases beyond the first that a test keeps.
SHARE = 0.022
# Examples of each property whose test names no number: in the sample, and in all.
FEW, MANY = 6, 25
# Begun first, so that no long test is the last one: most of these tests start processes.
FIRST = {"studies", "tests", "cli", "examples", "records"}
# Folders that keep every value of every parameter, and most cases that a test keeps for that.
WHOLE, MOST = {"oracles", "properties"}, 11
LEFT_OUT = pytest.StashKey[int]()
COLLECTED = pytest.StashKey[int]()


def pytest_addoption(parser):
    group = parser.getgroup("qpmhe")
    group.addoption("--all", action="store_true", help="run all cases of all tests, slow ones too")
    group.addoption(
        "--fuzz-steps", type=int, default=0, metavar="N",
        help="random steps to compare with the second implementation (default: some hundreds)",
    )
    group.addoption("--fuzz-seed", type=int, default=1, metavar="N", help="seed of these steps")


def pytest_configure(config):
    examples = MANY if config.option.all else FEW
    hypothesis.settings.register_profile("here", max_examples=examples)
    hypothesis.settings.load_profile("here")
    # No test depends on what the user's cache holds, or on what other tests have compiled.
    os.environ.setdefault("QPMHE_CACHE_DIR", str(config.cache.mkdir("libraries")))
    os.environ.setdefault("QPMHE_ENGINE", "python")


def named(config, item):
    """Whether the command line names this very case."""
    return any("::" in one and one.rpartition("::")[2] == item.name for one in config.args)


def sample(cases):
    """One of the cases and a share of the others, new values of the parameters first."""
    cases = sorted(cases, key=lambda item: hashlib.sha256(f"{SEED}{item.nodeid}".encode()).digest())
    seen, kept, others = set(), [], []
    for item in cases:
        values = {(name, id(value)) for name, value in item.callspec.params.items()}
        (others if values <= seen else kept).append(item)
        seen |= values
    wanted = 1 + round(SHARE * (len(cases) - 1))
    if cases[0].path.parent.name in WHOLE:
        wanted = max(wanted, min(len(kept), MOST))
    return (kept + others)[:wanted]


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    config.stash[COLLECTED] = config.stash[LEFT_OUT] = len(items)
    tests, kept = defaultdict(list), set()
    for item in items:
        if config.option.all or named(config, item):
            kept.add(item)
        elif item.get_closest_marker("slow") is None:
            tests[item.nodeid.partition("[")[0]].append(item)
    for cases in tests.values():
        kept.update(sample(cases) if len(cases) > 1 else cases)
    config.hook.pytest_deselected(items=[item for item in items if item not in kept])
    kept = [item for item in items if item in kept]
    items[:] = sorted(kept, key=lambda item: item.path.parent.name not in FIRST)
    config.stash[LEFT_OUT] -= len(items)


def pytest_sessionfinish(session):
    if hasattr(session.config, "workeroutput"):  # a process of pytest-xdist
        stash = session.config.stash
        session.config.workeroutput["left_out"] = stash.get(LEFT_OUT, 0), stash.get(COLLECTED, 0)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node, error):
    left_out, collected = getattr(node, "workeroutput", {}).get("left_out", (0, 0))
    node.config.stash[LEFT_OUT], node.config.stash[COLLECTED] = left_out, collected


def pytest_report_header(config):
    chosen = "all" if config.option.all else f"a sample (seed {SEED}); --all runs all of them"
    return f"cases: {chosen}"


def pytest_terminal_summary(terminalreporter, config):
    left_out, collected = config.stash.get(LEFT_OUT, 0), config.stash.get(COLLECTED, 0)
    if left_out:
        terminalreporter.write_line(
            f"{left_out} of {collected} cases left out; --all (make test-all) runs them too"
        )


@pytest.fixture(autouse=True)
def _no_figures_left():
    """Pyplot keeps the figures that it shows, and warns of too many."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")
