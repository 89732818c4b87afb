"""engine="auto": the compiled step where its library is ready, else Python's without a word."""

import os
import pickle
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from dataclasses import replace

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen import compiler, fingerprint, library, rehearsal
from qpmhe.errors import CompilationError, InvalidInputError, OptionError
from qpmhe.estimation.settings import Settings
from qpmhe.estimation.snapshot import read, written

from .cases import CASES, case
from .scripts import RIGHT, Script, needed

casadi = pytest.importorskip("casadi")
pytestmark = needed


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Of a compiler that is the same one for all tests, and of a library."""
    return tmp_path_factory.mktemp("compiler")


@pytest.fixture(autouse=True)
def script(folder, tmp_path, monkeypatch):
    """An empty cache, the usual "auto", and a compiler that counts its calls."""
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.delenv("QPMHE_ENGINE", raising=False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return Script(folder, monkeypatch)


@pytest.fixture
def filled(folder, tmp_path, script, monkeypatch):
    """The cache with the estimator's library, which is made once for all tests."""
    with monkeypatch.context() as patch:
        patch.setenv("QPMHE_CACHE_DIR", str(folder / "library"))
        name = compile_it().path.name
    shutil.copytree(folder / "library", tmp_path / "cache")
    script.log.unlink(missing_ok=True)
    return tmp_path / "cache" / name


def system(factor=0.9, **options):
    x = casadi.SX.sym("x", 2)
    f = casadi.Function("f", [x], [factor * x + 0.01 * casadi.sin(x)])
    return qpmhe.from_casadi(f, casadi.Function("h", [x], [x[0]]), compiled=False, **options)


def arguments(weight=1.0, horizon=3, **options):
    cost = qpmhe.QuadraticCost(prior=weight * np.eye(2), disturbance=np.eye(2), noise=weight)
    parts = system(**options), qpmhe.Luenberger([0.1 * weight, 0.1]), cost
    return parts, {"horizon": horizon, "initial_state": np.zeros(2)}


def estimator(weight=1.0, horizon=3, parts=None, **options):
    usual, shared = arguments(weight, horizon)
    with warnings.catch_warnings(action="error"):
        return qpmhe.MovingHorizonEstimator(*(parts or usual), **shared | options)


def compile_it(**options):
    parts, shared = arguments(**options)
    return qpmhe.compile(*parts, **shared)


def test_an_empty_cache_is_the_python_step_without_generating_anything(script, monkeypatch):
    monkeypatch.setattr(library, "estimator_files", None)
    mhe = estimator()
    assert mhe.settings.engine == "auto"
    assert (mhe.engine, mhe.update([1.0]).engine, mhe.run([1.0]).engine) == ("python",) * 3
    assert not script.calls


def test_what_was_compiled_is_taken_without_generating_it_again(script, monkeypatch):
    before = estimator()
    made = compile_it()
    assert made.is_new
    assert made.path.is_file()
    assert made.engine == "compiled"
    assert made.seconds > 0.0
    before.update([1.0])  # an estimator that exists keeps its engine
    before.reset()
    assert before.update([1.0]).engine == "python"
    calls = script.calls
    monkeypatch.setattr(library, "estimator_files", None)
    for mhe in (
        estimator(), estimator(weight=2.0, max_qps=3), estimator(warm_start=True, backend="banded"),
    ):
        assert (mhe.engine, mhe.update([1.0]).engine, mhe.run([1.0]).engine) == ("compiled",) * 3
    for options in (
        {"engine": "python"}, {"horizon": 4}, {"backend": "osqp"}, {"isolated": True},
        {"backend": qpmhe.solvers.create("osqp")},
    ):
        assert estimator(**options).engine == "python"
    again = qpmhe.compile(estimator())
    assert (again.is_new, again.path) == (False, made.path)
    assert script.calls == calls


def test_a_batch_has_one_engine():
    def batch():
        parts, shared = arguments()
        states = shared.pop("initial_state")
        return qpmhe.BatchEstimator(*parts, members=2, initial_states=states, **shared)

    ys = np.ones((2, 3, 1))
    one = batch()
    assert (one.engine, one.mode, one.run(ys).engine) == ("python", "looped", "python")
    compile_it()
    two = batch()
    found = two.update(ys[:, 0]).engine, two.run(ys).engine
    assert (two.engine, two.mode, *found) == ("compiled",) * 4
    assert pickle.loads(pickle.dumps(one)).engine == "python"
    assert pickle.loads(pickle.dumps(two)).engine == "compiled"


def test_no_option_and_no_part_is_refused(filled):
    (_, observer, cost), _ = arguments()
    plain = qpmhe.System(lambda x: [0.9 * x[0], 0.8 * float(x[1])], lambda x: x[:1], n=2, p=1)
    kalman = qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=np.eye(2), noise=[[1.0]])
    huber = qpmhe.RobustCost(prior=np.eye(2), disturbance=np.eye(2), noise=qpmhe.Huber([[1.0]]))
    boxed = system(states=qpmhe.Box([-5.0, -5.0], [5.0, 5.0]))
    for options in (
        {"time_budget": 1.0}, {"arrival": "smoothed"}, {"candidate": "reinitialized"}, {"delay": 2},
        {"parts": (system(), kalman, cost)}, {"parts": (system(), observer, huber)},
        {"parts": (boxed, observer, cost)}, {"parts": (plain, observer, cost)},
    ):
        assert np.isfinite(estimator(**options).update([1.0]).cost)


def test_the_environment_can_ask_for_python(filled, monkeypatch):
    assert estimator().engine == "compiled"
    monkeypatch.setenv("QPMHE_ENGINE", "python")
    assert estimator().engine == "python"
    monkeypatch.setenv("QPMHE_ENGINE", "fast")
    with pytest.raises(OptionError, match="QPMHE_ENGINE is 'fast'; expected 'python'"):
        estimator()


# Bad luck: no compiler, one that is broken or hangs, a cache that cannot be written.


def test_without_a_compiler(filled, monkeypatch):
    monkeypatch.setenv("CC", "/nowhere/cc")
    assert estimator().engine == "python"
    with pytest.raises(CompilationError, match="no C compiler"):
        compile_it()


def test_a_compiler_that_fails_or_hangs(script, monkeypatch):
    monkeypatch.setattr(compiler, "_PATIENCE", 0.2)
    for body, words, calls in (
        ("echo 'out of cheese' >&2; exit 1", "out of cheese", 3),
        ("exec sleep 600", r"did not end within 0\.2 s", 4),
    ):
        script.does(body)
        began = time.monotonic()
        with pytest.raises(CompilationError, match=words):
            compile_it()
        assert time.monotonic() - began < 60.0
        assert estimator().engine == "python"
        assert len(script.calls) == calls


def test_a_compiler_that_reads_standard_input(script):
    script.does(f"cat > /dev/null; {RIGHT}")
    before = os.dup(0)
    reading, writing = os.pipe()  # nobody ever writes to it
    try:
        os.dup2(reading, 0)
        assert compile_it().is_new
    finally:
        os.dup2(before, 0)
        for one in (before, reading, writing):
            os.close(one)


def test_wrong_code_is_not_used_and_not_compiled_again(filled, script, monkeypatch):
    compiler._checked.clear()
    monkeypatch.setattr(compiler, "_checked_by", lambda: "another release")
    monkeypatch.setattr(rehearsal, "estimator_fault", lambda *_: "J of the estimate is 2")
    assert estimator().engine == "python"
    assert not script.calls


@pytest.mark.parametrize("error", [RuntimeError, OSError, MemoryError, ValueError])
def test_no_error_of_the_compiled_step_is_raised(error, filled, monkeypatch):
    def fail(*_):
        raise error("out of cheese")

    monkeypatch.setattr(library, "planned", fail)
    assert estimator().engine == "python"


def test_damaged_and_foreign_files_in_the_cache(filled, tmp_path):
    filled.with_suffix(".sha256").write_text("nonsense")
    assert estimator().engine == "python"
    filled.with_suffix(".sha256").unlink()
    assert estimator().engine == "python"
    shutil.rmtree(tmp_path / "cache")
    (tmp_path / "cache").write_text("a file")
    assert estimator().engine == "python"


def test_a_cache_that_cannot_be_written_can_be_read(filled, script, monkeypatch):
    plain = os.access  # as it reports no folder to be writable: the tests may run as root
    with monkeypatch.context() as patch:
        patch.setattr(os, "access", lambda path, mode: not mode & os.W_OK and plain(path, mode))
        assert estimator().engine == "compiled"
        assert not compile_it().is_new
        assert estimator(horizon=4).engine == "python"
        with pytest.raises(CompilationError, match="cannot be written; set QPMHE_CACHE_DIR"):
            compile_it(horizon=4)
        assert estimator(engine="compiled").engine == "compiled"
    assert not script.calls


def test_what_lies_beside_a_cache_that_cannot_be_made_is_found(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(tmp_path / "file" / "below"))
    assert estimator().engine == "python"
    made = compile_it()
    assert made.path.parent.parent == tmp_path
    assert estimator().engine == "compiled"


PROGRAM = """
import numpy as np, casadi, qpmhe
x = casadi.SX.sym("x", 2)
system = qpmhe.from_casadi(
    casadi.Function("f", [x], [0.9 * x + 0.01 * casadi.sin(x)]),
    casadi.Function("h", [x], [x[0]]), compiled=False)
cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=1.0)
parts = system, qpmhe.Luenberger([0.1, 0.1]), cost
mhe = qpmhe.MovingHorizonEstimator(*parts, horizon=3, initial_state=np.zeros(2))
print(mhe.engine, mhe.update([1.0]).cost.hex())
"""


def test_the_same_model_of_another_process_is_in_the_cache(filled, script):
    mhe = estimator()
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, check=True)
    assert done.stdout.decode() == f"compiled {mhe.update([1.0]).cost.hex()}\n"
    assert not script.calls


# The key by which the cache knows a library.


def models():
    """Systems and horizons, most of which have source of their own."""
    x, u, ax = casadi.SX.sym("x", 2), casadi.SX.sym("u"), casadi.MX.sym("x", 2)
    h = casadi.Function("h", [x], [x[0]])
    rate = casadi.Function("f", [x], [-x])
    box, rows = qpmhe.Box([-1.0, -1.0], [1.0, 1.0]), qpmhe.Polytope([[1.0, 1.0]], [1.0])
    yield system(), 3
    yield system(), 4
    for one in (
        system(0.8), system(0.9 + 1e-15), system(disturbances=box), system(disturbances=rows),
        system(disturbances=qpmhe.Box([-2.0, -np.inf], [2.0, 9.0])),
        system(noises=qpmhe.Box([-1.0], [1.0])),
    ):
        yield one, 3
    for options in ({"dt": 0.1}, {"dt": 0.2}, {"dt": 0.1, "method": "euler"}, {}):
        yield qpmhe.from_casadi(rate, h, compiled=False, **options), 3
    f = casadi.Function("f", [x, u], [0.9 * x + u])
    yield qpmhe.from_casadi(f, h, compiled=False), 3
    inner = casadi.Function("inner", [ax], [casadi.cos(ax)])
    yield qpmhe.from_casadi(
        casadi.Function("f", [ax], [inner(ax)]), casadi.Function("h", [ax], [ax[:1]]),
        compiled=False,
    ), 3


class Captured(Exception):  # noqa: N818 - no error
    """What was to be compiled."""


def key_and_source(parts, settings, monkeypatch):
    """The key of an estimator's library, and its source without the data at its end."""
    def capture(files, main, key, check):
        raise Captured(key, files())

    monkeypatch.setattr(library, "compiled_library", capture)
    with pytest.raises(Captured) as caught:
        rehearsal.checked_library(*parts, replace(settings, engine="compiled"))
    key, files = caught.value.args
    code, mark, _ = files["mhe.c"].partition("/* Weights, gain, sets")
    assert mark
    return key, files["mhe.h"] + code


@pytest.mark.parametrize("step", [5, pytest.param(1, marks=pytest.mark.slow)])
def test_keys_differ_where_the_source_does(step, monkeypatch):
    (_, observer, cost), _ = arguments()
    estimators = [((model, observer, cost), Settings(horizon)) for model, horizon in models()]
    for name in list(CASES)[::step]:
        one = case(name).estimator("python")
        estimators.append(((one.system, one.observer, one.cost), one.settings))
    found = [key_and_source(*one, monkeypatch) for one in estimators]
    keys, sources = zip(*found, strict=True)
    assert None not in keys
    for key, text in found:
        assert [one == key for one in keys] == [one == text for one in sources]
    assert len(set(keys)) < len(keys)  # sampling times, weights and options are data


@pytest.mark.parametrize("name", ["c/step.c", "c/estimator.h", "source.py"])
def test_keys_change_with_the_generator(name, tmp_path, monkeypatch):
    model = system().symbolic
    before = fingerprint.source_key(model)
    here = os.path.dirname(fingerprint.__file__)
    shutil.copytree(here, tmp_path / "codegen")
    monkeypatch.setattr(fingerprint, "files", lambda _: tmp_path / "codegen")
    try:
        fingerprint._generator.cache_clear()
        assert fingerprint.source_key(model) == before
        with (tmp_path / "codegen" / name).open("a") as file:
            file.write("\n")
        fingerprint._generator.cache_clear()
        assert fingerprint.source_key(model) != before
    finally:
        fingerprint._generator.cache_clear()


def test_a_model_without_a_key_is_compiled_and_left_to_python_by_auto(monkeypatch):
    monkeypatch.setattr(library, "source_key", lambda *_: None)
    assert estimator(engine="compiled").engine == "compiled"
    assert estimator().engine == "python"
    with pytest.raises(CompilationError, match="cannot serialize"):
        compile_it()


# Snapshots go on with the engine that they were taken with.


def snapshot_of(mhe):
    """A snapshot in a record's middle, the estimator pickled there, and what comes next."""
    for y in (1.0, 2.0, np.nan, 1.5):
        mhe.update([y])
    return mhe.state_dict(), pickle.dumps(mhe), mhe.update([1.0])


def goes_on(one, wanted, engine):
    found = one.update([1.0])
    assert (one.engine, found.engine) == (engine, engine)
    np.testing.assert_array_equal(found.trajectory, wanted.trajectory)


def test_a_snapshot_pins_the_python_step():
    mhe = estimator()
    snapshot, kept, wanted = snapshot_of(mhe)
    assert read(snapshot)["engine"] == "python"
    compile_it()
    other, copy = estimator(), pickle.loads(kept)
    assert other.engine == "compiled"
    assert copy.settings == mhe.settings
    other.load_state_dict(snapshot)
    for one in (other, copy):
        goes_on(one, wanted, "python")
    with pytest.raises(InvalidInputError, match="engine='python'; expected 'compiled'"):
        estimator(engine="compiled").load_state_dict(snapshot)


def test_a_snapshot_pins_the_compiled_step(filled, tmp_path, monkeypatch):
    snapshot, kept, wanted = snapshot_of(estimator())
    monkeypatch.setenv("QPMHE_ENGINE", "python")
    other = estimator()
    other.load_state_dict(snapshot)
    for one in (other, pickle.loads(kept)):
        goes_on(one, wanted, "compiled")
    # Without its library the snapshot is refused, and the estimator stays as it was.
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(tmp_path / "empty"))
    mhe = estimator()
    mhe.update([1.0])
    for match in ("not in the cache", "qpmhe.compile", "engine='compiled'"):
        with pytest.raises(InvalidInputError, match=match):
            mhe.load_state_dict(snapshot)
    assert (mhe.engine, mhe.time) == ("python", 1)
    with pytest.raises(InvalidInputError, match="which is not ready here"):
        estimator(backend="osqp").load_state_dict(snapshot)
    for name in ("fast", 3, None):
        with pytest.raises(InvalidInputError):
            mhe.load_state_dict(written(read(snapshot) | {"engine": name}))
    # An estimator that was pickled waits for the compiler, as it was made to run it.
    assert pickle.loads(kept).engine == "compiled"


def test_compile_validates_its_arguments():
    parts, shared = arguments()
    plain = qpmhe.System(lambda x: [0.9 * x[0], 0.8 * float(x[1])], lambda x: x[:1], n=2, p=1)
    for given, options, error, words in (
        ((estimator(),), {"horizon": 3}, InvalidInputError, "leave them out"),
        (parts, {"horizn": 3, **shared}, OptionError, "horizn"),
        (parts[:1], shared, InvalidInputError, "observer is None"),
        (parts, {"backend": "osqp", **shared}, OptionError, "solves its QPs itself"),
        (parts, {"isolated": True, **shared}, OptionError, "isolated is True"),
        ((plain, *parts[1:]), shared, OptionError, "no C code for this estimator"),
    ):
        with pytest.raises(error, match=words):
            qpmhe.compile(*given, **options)
