"""Whether `run` compiles before a record: when, and what happens where that fails."""

import os
import shutil
import time

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen import payoff
from qpmhe.codegen.payoff import samples_that_pay

from .test_compiler import CC, RIGHT, counting_script

pytestmark = pytest.mark.skipif(
    CC is None or os.name != "posix", reason="there is no C compiler, or none that is a script"
)
ENOUGH = 60
RECORD = np.random.default_rng(0).standard_normal((ENOUGH, 1))


@pytest.fixture
def cache(tmp_path):
    return tmp_path / "cache"


@pytest.fixture(autouse=True)
def script(tmp_path, cache, monkeypatch):
    """As for the compiler's tests, with records that pay soon."""
    monkeypatch.setattr(payoff, "samples_that_pay", lambda *_: ENOUGH)
    return counting_script(tmp_path, cache, monkeypatch)


def estimator(f=lambda x: [0.9 * x[0] + 0.1 * x[1], 0.8 * x[1] - 0.1 * x[0] ** 3], **options):
    system = qpmhe.System(f, lambda x, *u: x[:1], n=2, p=1)
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=10 * np.eye(2), noise=4.0)
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.3, 0.1]), cost,
        **{"horizon": 4, "initial_state": [0.5, 0.0]} | options,
    )


def same(run, other):
    for name in ("states", "filtered", "costs", "candidate_costs", "observer_states", "flags"):
        assert np.array_equal(getattr(run, name), getattr(other, name)), name


@pytest.mark.parametrize(("body", "words"), [
    ("echo 'out of cheese' >&2\nexit 1", "out of cheese"),
    ("kill -9 $$", "exit status -9"),
    ('exec 3> "$COMPILER_LOG.pipe"\necho begun >&3\nsleep 600\ntrue', "did not end within"),
    (None, "there is no C compiler"),
], ids=["fails", "killed", "hangs", "missing"])
def test_where_compiling_fails_the_python_step_runs_and_no_one_waits_twice(
    body, words, script, cache, monkeypatch
):
    if "end" in words:
        monkeypatch.setattr(payoff, "PATIENCE", 2.0)
        os.mkfifo(f"{script.log}.pipe")
        pipe = os.open(f"{script.log}.pipe", os.O_RDONLY | os.O_NONBLOCK)
    script.does(body or "")
    if body is None:
        monkeypatch.setenv("CC", "/nowhere/cc")
    expected = estimator(engine="python").run(RECORD)
    for attempt in range(2):
        mhe, calls = estimator(), len(script.calls)
        run = mhe.run(RECORD)
        assert (mhe.engine, run.engine) == ("python", "python")
        assert words in run.engine_reason
        assert run.engine_reason in run.facts()["engine"]
        same(run, expected)
        assert (len(script.calls) > calls) == (attempt == 0 and body is not None)
    assert words in qpmhe.codegen.engine_choice(mhe)[1]
    left = [path.suffix for path in cache.glob("*")]
    assert left == ([] if body is None else [".failed"])
    if "end" in words:
        # The compiler's own processes have ended, too: nobody can write any more.
        assert os.read(pipe, 100) == b"begun\n"
        assert os.read(pipe, 100) == b""
        os.close(pipe)


def test_a_failure_counts_for_a_day_and_for_this_version(script, cache, monkeypatch):
    script.does("exit 1")
    estimator().run(RECORD)
    (note,), calls = cache.glob("*.failed"), len(script.calls)
    kept = note.read_text()
    for change in (
        lambda: os.utime(note, 2 * (time.time() - 2 * 86400,)),
        lambda: note.write_text(kept.replace("right by", "right by another")),
        lambda: note.write_text(""),
    ):
        estimator().run(RECORD)
        assert len(script.calls) == calls
        change()
        estimator().run(RECORD)
        assert len(script.calls) > calls
        calls = len(script.calls)


def test_where_no_folder_can_be_written_nobody_calls_the_compiler(script, cache, monkeypatch):
    plain = os.access  # as it reports no folder to be writable: the tests may run as root
    monkeypatch.setattr(
        os, "access", lambda path, mode: not mode & os.W_OK and plain(path, mode)
    )
    run = estimator().run(RECORD)
    assert run.engine == "python"
    assert "cannot be written" in run.engine_reason
    assert not script.calls


def test_nobody_compiles_who_has_chosen_or_has_begun_or_has_few_samples(script, monkeypatch):
    begun = estimator()
    begun.update(RECORD[0])
    with_a_branch = estimator(lambda x: [0.9 * x[0], 0.8 * float(x[1])])
    for mhe, record, options, words in (
        (estimator(engine="python"), RECORD, {}, ""),
        (estimator(backend="osqp"), RECORD, {}, ""),
        (estimator(isolated=True, max_qps=0), RECORD, {}, ""),
        (begun, RECORD, {}, ""),
        (estimator(), RECORD, {"may_compile": False}, ""),
        (estimator(), RECORD[:5], {}, ""),
        (estimator(), RECORD[:-1], {}, f"from about {ENOUGH} samples on, and these are 59"),
        (with_a_branch, RECORD, {}, ""),
    ):
        run = mhe.run(record, **options)
        assert run.engine == "python"
        assert words in run.engine_reason
        assert bool(run.engine_reason) == bool(words)
    monkeypatch.setenv("QPMHE_ENGINE", "python")
    assert estimator().run(RECORD).engine_reason == ""
    assert not script.calls
    with pytest.raises(qpmhe.errors.OptionError, match="may_compile"):
        estimator().run(RECORD, may_compile=1)


def test_the_estimate_of_what_pays_grows_with_the_work():
    def needed(n, **options):
        rng = np.random.default_rng(n)
        W = rng.standard_normal((n, n)) / n
        system = qpmhe.System(
            lambda x: 0.9 * x + np.tanh((W * x).sum(axis=1)), lambda x: x[:1], n=n, p=1
        )
        cost = qpmhe.QuadraticCost(prior=np.eye(n), disturbance=np.eye(n), noise=1.0)
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger(0.1 * np.eye(n, 1)), cost, initial_state=np.zeros(n),
            **{"horizon": 20, "engine": "python"} | options,
        )
        return samples_that_pay(mhe.system, mhe.observer, mhe.settings)

    usual = needed(4)
    assert 3_000 < usual < 40_000
    # The more QPs, states or stages, the more the compiled step saves.
    assert needed(4, max_qps=0) > usual > needed(4, max_qps=2) > needed(4, max_qps=None)
    assert needed(40) < usual
    assert needed(40, horizon=40) < needed(40)


def test_a_long_record_is_compiled_first_and_what_ran_is_pinned(script, cache):
    def prepared(**options):
        mhe = estimator(**options)
        mhe.set(noise_weight=[[2.0]])
        mhe.reset([0.2, 0.1])
        return mhe

    mhe = prepared()
    assert mhe.engine == "python"
    run = mhe.run(RECORD)
    assert (mhe.engine, run.engine) == ("compiled", "compiled")
    assert run.engine_reason == f"compiling pays from about {ENOUGH} samples on, and these are 60"
    assert len(script.calls) == 1
    other = prepared(engine="compiled")
    same(run, other.run(RECORD))
    assert len(script.calls) == 1
    assert mhe.update([0.3]).cost == other.update([0.3]).cost
    np.testing.assert_allclose(
        run.states, prepared(engine="python").run(RECORD).states, rtol=1e-9, atol=1e-12
    )
    # A snapshot, and what is loaded from it, has the engine that ran.
    state = mhe.state_dict()
    with pytest.raises(qpmhe.errors.InvalidInputError, match="engine"):
        estimator(engine="python").load_state_dict(state)
    fresh = estimator()
    fresh.load_state_dict(state)
    assert fresh.engine == "compiled"
    assert fresh.update([0.1]).cost == mhe.update([0.1]).cost
    # What was compiled after an estimator was made is found by its next record.
    shutil.rmtree(cache)
    late = estimator()
    qpmhe.compile(estimator())
    assert late.run(RECORD[:10]).engine_reason == "its library is in the cache"
    assert late.engine == "compiled"


def test_a_failure_is_forgotten_once_compiling_succeeds(script, cache):
    script.does("exit 1")
    assert estimator().run(RECORD).engine == "python"
    script.does(RIGHT)
    assert estimator().run(RECORD).engine == "python"  # the compiler's file is the same
    qpmhe.compile(estimator())
    assert not list(cache.glob("*.failed"))
    assert estimator().run(RECORD).engine == "compiled"


def test_sparse_jacobians_of_many_states_stay_with_the_python_step(script):
    """Its band is narrower than the blocks of the step in C."""
    n = 84

    def f(x):
        return x + 0.1 * (np.append(x[:1], x[:-1]) - 2.0 * x + np.append(x[1:], x[-1:]))

    system = qpmhe.System(f, lambda x: x[::4], n=n, p=n // 4)
    gain = 0.3 * np.eye(n)[:, ::4]
    cost = qpmhe.QuadraticCost(prior=np.eye(n), disturbance=np.eye(n), noise=np.eye(n // 4))
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(gain), cost, horizon=4, initial_state=np.zeros(n), max_qps=1
    )
    run = mhe.run(np.zeros((ENOUGH, n // 4)))
    assert run.engine == "python"
    assert "Jacobians are sparse" in run.engine_reason
    assert qpmhe.codegen.engine_choice(mhe) == ("python", f"{run.engine_reason}.")
    assert not script.calls
