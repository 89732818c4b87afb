"""The written C: compiled without a warning, run under sanitizers, compared with Python."""

import dataclasses
import itertools
import re
import shutil
import subprocess
from types import SimpleNamespace

import numpy as np
import pytest

import qpmhe
from qpmhe import Status, codegen
from qpmhe.codegen.library import generated
from qpmhe.errors import InvalidInputError, OptionError, QpmheError

ca = pytest.importorskip("casadi")
pytestmark = [
    pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler"),
    pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning"),
]

STRICT = ["-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror"]
WATCHED = ["-std=c99", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover"]
PUBLIC = ["amend", "default_settings", "recompute", "reset", "run", "sizes", "update",
          "set", "undo", "update_members", "update_special", "update_undoable"]

# Reads options and commands as doubles: 0 update, 1 special update, 2 amend, 3 run, 4 set.
PROGRAM = r"""
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "mhe.h"

static double number(void)
{
    double v;
    if (fread(&v, sizeof v, 1, stdin) != 1) exit(0);
    return v;
}

static mhe_real *numbers(size_t count)
{
    mhe_real *to = malloc(sizeof(mhe_real) * (count + 1));
    for (size_t i = 0; i < count; i++) to[i] = (mhe_real)number();
    return to;
}

static void put(double v) { fwrite(&v, sizeof v, 1, stdout); }

static void show(int count, const mhe_real *from)
{
    for (int i = 0; i < count; i++) put(from[i]);
}

static void tell(const mhe_estimate *o)
{
    const int n = o->length;
    put(n); put((double)o->time); put(o->status); put(o->qps); put(o->nearest_points);
    put(o->cost); put(o->candidate_cost);
    show((n + 1) * MHE_NX, o->trajectory); show((n + 1) * MHE_NX, o->candidate);
    show(n * MHE_NX, o->disturbances); show(n * MHE_NY, o->noises);
    show(MHE_NX, o->filtered); show(MHE_NX, o->observer_state);
}

static mhe_settings settings;

static void run(mhe_workspace *k)
{
    const int members = (int)number(), samples = (int)number(), count = members * samples;
    mhe_estimator *es = malloc(sizeof *es * (size_t)members);
    mhe_real *x0 = numbers((size_t)members * MHE_NX), *y = numbers((size_t)count * MHE_NY);
    mhe_real *u = numbers((size_t)count * MHE_NU), *out = malloc(sizeof *out * (size_t)count * 99);
    int32_t *flags = malloc(sizeof *flags * (size_t)count * 3);
    mhe_log log = {out, out + count * MHE_NX, out + 2 * count * MHE_NX, out + 3 * count * MHE_NX,
                   out + (3 * MHE_NX + 1) * count, flags, flags + count, flags + 2 * count,
                   out + (3 * MHE_NX + 2) * count,
#if MHE_SENSORS
                   0,
#endif
                   };
    const mhe_log nothing = {0};
    for (int silent = 0; silent < 2; silent++) {
        for (int i = 0; i < members; i++)
            mhe_reset(es + i, &settings, x0 + i * MHE_NX);
        mhe_run(es, members, k, samples, y, MHE_NU ? u : 0, silent ? &nothing : &log);
    }
    for (int j = 0; j < 3 * MHE_NX; j++) show(count, out + j * count);
    show(count * MHE_NX, log.observer_states);
    show(2 * count, log.costs);
    for (int i = 0; i < 2 * count; i++) put(flags[i]);
    mhe_estimate *os = malloc(sizeof *os * (size_t)members);
    for (int i = 0; i < members; i++) mhe_reset(es + i, &settings, x0 + i * MHE_NX);
    mhe_update_members(es, members, k, y, MHE_NU ? u : 0, os);
    for (int i = 0; i < members; i++) show(MHE_NX, os[i].trajectory + os[i].length * MHE_NX);
    free(os);
    free(es); free(x0); free(y); free(u); free(out); free(flags);
}

int main(void)
{
    mhe_estimator *e = malloc(sizeof *e);
    mhe_workspace *k = malloc(sizeof *k);
    mhe_estimate *o = malloc(sizeof *o);
    settings = mhe_default_settings;
    if (number() != 0) {
        settings.max_qps = (int32_t)number();
        settings.infeasible = (int32_t)number();
        settings.start_at_best = (int32_t)number();
        settings.delay = (int32_t)number();
    }
    mhe_real *x0 = numbers(MHE_NX);
    mhe_reset(e, &settings, x0);
    for (;;) {
        const int command = (int)number();
        const int64_t time = command == 2 ? (int64_t)number() : 0;
        if (command == 3) {
            run(k);
            continue;
        }
        mhe_real *y = numbers(MHE_NY), *u = numbers(command < 2 ? MHE_NU : 0);
        if (command == 0) mhe_update(e, k, y, MHE_NU ? u : 0, o);
        if (command == 1) {
            const mhe_real step = (mhe_real)number();
            const int own = number() != 0, weighs = number() != 0, narrows = number() != 0;
            mhe_real *R = numbers(MHE_NY * MHE_NY), *Q = numbers(MHE_NX * MHE_NX);
            uint8_t *mask = malloc(MHE_NY);
            mhe_sample sample = {0};
            mhe_w_set *W = malloc(sizeof *W); /* of which only the sides may be read */
            memcpy(W->lower, settings.disturbances.lower, sizeof W->lower);
            memcpy(W->row_lower, settings.disturbances.row_lower, sizeof W->row_lower);
            memcpy(W->row_upper, settings.disturbances.row_upper, sizeof W->row_upper);
            for (int j = 0; j < MHE_NX; j++) {
                W->upper[j] = settings.disturbances.upper[j] / 2;
                if (W->upper[j] < W->lower[j]) W->upper[j] = W->lower[j];
            }
            for (int j = 0; j < MHE_NY; j++) mask[j] = number() != 0;
            sample.y = y, sample.u = MHE_NU ? u : 0, sample.step = step;
            sample.noise_weight = own ? R : 0, sample.disturbance_weight = weighs ? Q : 0;
            sample.sampled = mask, sample.disturbances = narrows ? W : 0;
            mhe_update_special(e, k, &sample, o);
            free(R), free(Q), free(mask), free(W);
        }
        if (command == 2) put(mhe_amend(e, k, time, y, o));
        if (command == 4) {
            const mhe_real factor = (mhe_real)number();
            mhe_real *R = numbers(MHE_NY * MHE_NY);
            for (int j = 0; j < MHE_NY * MHE_NY; j++) settings.noise_weight[j] *= factor;
#if MHE_COVARIANCE
            memcpy(settings.covariances.noise, R, sizeof settings.covariances.noise);
#endif
            free(R);
            mhe_set(e, k, &settings, MHE_NOISE_WEIGHT, 0, 0, o);
        }
        tell(o);
        free(y); free(u); free(k);
        k = malloc(sizeof *k); /* scratch: nothing of it may be needed again */
    }
}
"""


def model(kind="SX", n=3, p=2, m=0, method=None, **sets):
    """A mildly nonlinear, stable system of any size."""
    rng = np.random.default_rng(7)
    symbol = ca.SX if kind == "SX" else ca.MX
    x, u = symbol.sym("x", n), symbol.sym("u", m)
    A, shift = rng.uniform(-0.3, 0.3, (n, n)), ca.vertcat(*[x[(i + 1) % n] for i in range(n)])
    rate = ca.DM(A) @ x + 0.2 * ca.sin(shift) - 0.4 * x + (0.3 * u[0] if m else 0)
    if kind == "MX":  # keeps the function from being expanded to scalars
        rate += 0.1 * ca.logsumexp(ca.vertcat(x, 0.3))
    outputs = [(1 + 0.1 * i) * x[i % n] + 0.1 * x[(i + 1) % n] ** 2 for i in range(p)]
    h = ca.vertcat(*outputs) + (0.1 * u[-1] if m else 0)
    given = [x, u] if m else [x]
    return qpmhe.from_casadi(
        ca.Function("f", given, [rate if method else x + 0.2 * rate]),
        ca.Function("h", given, [h]),
        dt=0.2 if method else None, method=method or "rk4", compiled=False, **sets,
    )


def estimator(system, horizon=4, seed=3, **options):
    rng = np.random.default_rng(seed)
    n, p = system.n, system.p
    W = rng.standard_normal((p, p))
    cost = qpmhe.QuadraticCost(
        prior=2.0 * np.eye(n), disturbance=20.0 * np.eye(n) + 2.0,
        noise=10.0 * (W @ W.T + np.eye(p)), discount=options.pop("discount", 1.0),
    )
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(rng.uniform(-0.15, 0.15, (n, p))), cost, horizon=horizon,
        initial_state=np.zeros(n), solver_tolerance=1e-10, **options,
    )


def box(size, width):
    return qpmhe.Box(-width * np.arange(1, size + 1), [np.inf] + [width] * (size - 1))


def polytope(size, width):
    rows = np.cos(np.arange(2 * size)).reshape(2, size)
    return qpmhe.Box([-width] * size, [width] * size) & qpmhe.Polytope(rows, [width, 0.8 * width])


def compiled(mhe, folder, flags=WATCHED, name="mhe", **options):
    folder.mkdir(exist_ok=True)
    header, source = codegen.write(mhe, folder, name=name, **options)
    assert (header, source) == (folder / f"{name}.h", folder / f"{name}.c")
    names = {"mhe": name, "MHE": name.upper()}
    text = re.sub(r"\b(mhe|MHE)(?=[_.])", lambda found: names[found[0]], PROGRAM)
    (folder / "program.c").write_text(text)
    command = ["cc", *flags, "-o", "program", "program.c", source.name, "-lm"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder / "program"


def answers(program, options, *parts):
    """What a program writes; options: those of an estimator it was not written from."""
    given = [0] if options is None else [
        1, options.qp_limit, ["drop_rows", "keep_candidate"].index(options.infeasible),
        options.warm_start, options.delay,
    ]
    parts = (given, *parts)
    data = np.concatenate([np.ravel(np.asarray(part, np.float64)) for part in parts])
    done = subprocess.run(
        [program], input=data.tobytes(), capture_output=True, check=False, timeout=60,
        env={"ASAN_OPTIONS": "detect_leaks=0"},
    )
    assert done.returncode == 0, done.stderr.decode()[-3000:]
    assert not done.stderr
    return np.frombuffer(done.stdout)


def play(program, mhe, commands, options=None):
    """The estimates of a program."""
    n, p, estimates = mhe.system.n, mhe.system.p, []
    numbers = answers(program, options, mhe.initial_state, *itertools.chain(*commands))
    for command in commands:
        if command[0] == 2:
            assert numbers[0] == 0.0
            numbers = numbers[1:]
        head, numbers = numbers[:7], numbers[7:]
        K = int(head[0])
        shapes = [(K + 1, n), (K + 1, n), (K, n), (K, p), (n,), (n,)]
        parts = np.split(numbers, np.cumsum([np.prod(shape) for shape in shapes]))
        numbers = parts.pop()
        arrays = [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]
        estimates.append(SimpleNamespace(
            time=int(head[1]), status=Status(int(head[2])), qps=int(head[3]), cost=head[5],
            candidate_cost=head[6], trajectory=arrays[0], candidate=arrays[1],
            disturbances=arrays[2], noises=arrays[3], filtered=arrays[4], observer_state=arrays[5],
            nearest_points=int(head[4]),
        ))
    assert numbers.size == 0
    return estimates


def record(mhe, steps=14, seed=0, spread=0.1, special=True):
    """Commands, and the Python step's estimates: all sorts of samples, and late ones."""
    rng, system = np.random.default_rng(seed), mhe.system
    n, p, m = system.n, system.p, system.m
    x, commands, expected = rng.uniform(-0.5, 0.5, n), [], []
    for t in range(steps):
        u = rng.uniform(-0.5, 0.5, m)
        y = system.h(x, u) + spread * rng.standard_normal(p)
        x = system.f(x, u) + 0.5 * spread * rng.standard_normal(n)
        if special and t % 4 == 2:
            y[t % p] = [np.nan, np.inf, -np.inf, 1e200][t // 4 % 4]
        if special and t == 7:
            y[:] = np.nan
        options, own, weight = {}, np.eye(p) * 5.0 + 1.0, np.eye(n) * 15.0 + 1.0
        mask, one = np.ones(p), system.disturbances
        if special and t % 5 == 3:
            options["noise_weight"] = own
        if special and t % 5 == 4:
            options["disturbance_weight"] = weight
        if special and t % 6 == 5:
            mask[t % p] = p == 1
            options["sensors"] = mask > 0
        if special and t % 7 == 6 and one is not None:
            options["bounds"] = {"disturbances": one.with_sides(
                one.lower, np.maximum(0.5 * one.upper, one.lower), one.row_lower, one.row_upper)}
        if special and system.dt and t % 5 in (1, 3):
            options["dt"] = 0.35
        commands.append(
            (1, y, u, options.get("dt", 0.0), "noise_weight" in options,
             "disturbance_weight" in options, "bounds" in options, own, weight, mask)
            if options else (0, y, u)
        )
        expected.append(mhe.update(y[mask > 0], u if m else None, **options))
        if special and t % 8 == 6:
            usual = mhe.usual.noise_weight
            usual = mhe.cost.noise if usual is None else usual
            commands.append((4, np.zeros(p), 1.5, np.linalg.inv(1.5 * usual)))
            expected.append(mhe.set(noise_weight=1.5 * usual))
        if special and t % 6 == 4:
            late = rng.uniform(-0.3, 0.3, p)
            late[: p // 2] = np.nan
            time = max(0, t + 1 - mhe.horizon)
            commands.append((2, time, late))
            expected.append(mhe.amend(time, late))
    return commands, expected


def check(found, expected, tolerance, statuses=True):
    for one, other in zip(found, expected, strict=True):
        assert one.time == other.time
        assert one.cost <= one.candidate_cost
        if statuses:
            assert one.status == other.status
        for name in (
            "trajectory", "candidate", "disturbances", "noises", "filtered", "observer_state"
        ):
            np.testing.assert_allclose(
                getattr(one, name), getattr(other, name), rtol=0, atol=tolerance, err_msg=name
            )
        assert one.cost == pytest.approx(other.cost, rel=tolerance, abs=tolerance)


VARIANTS = list(itertools.product(("SX", "MX"), (0, 2), (None, "euler", "rk4")))
SIZES = [(3, 2), (1, 1), (1, 3)]
MADE = [lambda size: None, lambda size: box(size, 1.0), lambda size: polytope(size, 1.0)]


@pytest.mark.parametrize("which", list(itertools.product(range(3), repeat=2)), ids=str)
def test_compiles_without_warnings(which, tmp_path):
    index = int(np.dot(which, [3, 1]))
    for turn in range(4):
        kind, m, method = VARIANTS[(index + 5 * turn) % len(VARIANTS)]
        n, p = SIZES[(index + turn) % 3]
        sets = {
            name: MADE[one](size)
            for name, one, size in zip(
                ("disturbances", "noises", "states"), (*which, (index + turn) % 3), (n, p, n),
                strict=True,
            )
        }
        mhe = estimator(model(kind, n, p, m, method, **sets), horizon=1 + index % 3)
        real = ("double", "float")[(index + turn) % 2]
        _, source = codegen.write(mhe, tmp_path, real=real)
        extra = ["-Wshadow", "-Wconversion"] if real == "double" else []
        done = subprocess.run(
            ["cc", *STRICT, *extra, "-fsyntax-only", source], capture_output=True, text=True,
            check=False,
        )
        assert done.returncode == 0, (kind, n, p, m, method, real, done.stderr[:2000])


CASES = {
    "map": ({}, {"max_qps": None}),
    "one of each": ({"n": 1, "p": 1}, {"horizon": 1}),
    "many outputs": ({"n": 1, "p": 3, "m": 1}, {"horizon": 3, "max_qps": 2}),
    "Euler": ({"method": "euler", "m": 2}, {"warm_start": True, "max_qps": 2, "discount": 0.9}),
    "Runge-Kutta": ({"method": "rk4", "n": 4}, {"candidate": "reinitialized"}),
    "matrices": ({"kind": "MX", "method": "rk4", "m": 1}, {"horizon": 1, "max_qps": 2}),
    "observer": ({"m": 1}, {"max_qps": 0}),
    "states": ({"m": 1, "states": box(3, 0.15)}, {"max_qps": 2}),
    "states, observer": ({"m": 1, "states": polytope(3, 0.2)}, {"max_qps": 0}),
    "states of an ODE": (
        {"m": 1, "method": "rk4", "states": polytope(3, 0.2)}, {"candidate": "reinitialized"}
    ),
    "noise-free": (
        {"disturbances": qpmhe.Box([-1.0, 0.01, -1.0], [1.0, 0.01, 1.0])}, {"max_qps": 2}
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_gives_what_python_gives(case, tmp_path):
    size, options = CASES[case]
    mhe = estimator(model(**size), **options)
    program = compiled(mhe, tmp_path)
    commands, expected = record(mhe)
    found = play(program, mhe, commands)
    check(found, expected, 1e-9)
    assert [one.qps for one in found] == [one.qps for one in expected]


WIDE = {"disturbances": 0.05, "noises": 0.15}
POLICIES = [("drop_rows", False), ("keep_candidate", False), ("drop_rows", True)]


def constrained(infeasible="drop_rows", warm_start=False, **options):
    sets = {
        name: polytope(2 if name == "noises" else 3, width) for name, width in WIDE.items()
    }
    return estimator(
        model(m=1, **sets), infeasible=infeasible, warm_start=warm_start, max_qps=20, **options
    )


@pytest.fixture(scope="module")
def with_sets(tmp_path_factory):
    """A program whose options are set when it runs."""
    return compiled(constrained(), tmp_path_factory.mktemp("sets"))


@pytest.mark.parametrize(("infeasible", "start"), POLICIES)
def test_inequalities_bind_as_in_python(infeasible, start, with_sets):
    mhe = constrained(infeasible, start)
    commands, expected = record(mhe, 16, spread=0.06)
    found = play(with_sets, mhe, commands, mhe.settings)
    check(found, expected, 1e-5, statuses=False)
    outcome = Status.ROWS_DROPPED | Status.CANDIDATE_OUTSIDE | Status.IMPROVED
    assert [one.status & outcome for one in found] == [one.status & outcome for one in expected]
    free = estimator(model(m=1), warm_start=start, max_qps=20)
    _, without = record(free, 16, spread=0.06)
    moved = [abs(one.cost - other.cost) for one, other in zip(found, without, strict=True)]
    assert max(moved) > 1e-3  # otherwise nothing was active


@pytest.mark.parametrize("horizon", [2, 4])
def test_curved_sets_of_more_outputs_than_states(horizon, tmp_path):
    x, none = ca.SX.sym("x", 1), np.zeros(0)
    rng = np.random.default_rng(1)
    h = ca.vertcat(*[ca.sin((1 + i) * x) + 0.3 * x**2 for i in range(3)])
    system = qpmhe.from_casadi(
        ca.Function("f", [x], [0.9 * x + 0.2 * ca.sin(x)]), ca.Function("h", [x], [h]),
        compiled=False, noises=box(3, 0.12),
    )
    mhe = estimator(system, horizon, max_qps=None)
    program = compiled(mhe, tmp_path)
    state, commands, expected = np.array([0.4]), [], []
    for _ in range(20):
        y = system.h(state, none) + rng.uniform(-0.1, 0.1, 3)
        state = system.f(state, none)
        commands.append((0, y))
        expected.append(mhe.update(y))
    bent = [
        Status.CANDIDATE_OUTSIDE in one.status and one.corrections > 0 and one.improved
        for one in expected
    ]
    assert any(bent)
    found = play(program, mhe, commands)
    for one, other, there in zip(found, expected, bent, strict=True):
        if there:
            assert Status.IMPROVED in one.status
            assert one.cost == pytest.approx(other.cost, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("n", [23, 24, 33])
def test_any_number_of_states(n, tmp_path):
    mhe = estimator(model(n=n), horizon=2)
    program = compiled(mhe, tmp_path, ["-std=c99", "-O0"])
    commands, expected = record(mhe, 5, special=False)
    check(play(program, mhe, commands), expected, 1e-9)


def broken(horizon, **options):
    """A system that has no value where x < 0."""
    x = ca.SX.sym("x")
    system = qpmhe.from_casadi(
        ca.Function("f", [x], [0.7 * x + 0.2 * ca.sqrt(x)]), ca.Function("h", [x], [x]),
        compiled=False,
    )
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([[0.5]]),
        qpmhe.QuadraticCost(prior=1.0, disturbance=10.0, noise=1.0), horizon=horizon,
        initial_state=[0.5], **options,
    )


@pytest.mark.parametrize("horizon", [1, 4])
def test_held_stages(horizon, tmp_path):
    program = compiled(broken(horizon), tmp_path)
    ys = [0.6, 0.8, 0.9, 1.0, -20.0, 0.9, np.nan, 1.0, -30.0, -30.0, 1.1, 1.0, 0.9, 0.9, 0.8]
    for options in ({"max_qps": 0}, {"max_qps": 2}, {"max_qps": 2, "warm_start": True}):
        mhe = broken(horizon, **options)
        expected = [mhe.update([y]) for y in ys]
        assert any(Status.MODEL_FAILED in one.status for one in expected)
        check(play(program, mhe, [(0, y) for y in ys], mhe.settings), expected, 1e-9)


def test_records_of_several_members(with_sets):
    mhe = constrained(delay=2)
    n, p, members, samples = 3, 2, 3, 12
    rng = np.random.default_rng(9)
    x0 = rng.uniform(-0.2, 0.2, (members, n))
    ys = rng.uniform(-0.3, 0.3, (members, samples, p))
    us = rng.uniform(-1.0, 1.0, (members, samples, 1))
    ys[1, 4], ys[2, 5, 0] = np.nan, np.nan
    numbers = answers(with_sets, mhe.settings, np.zeros(n), 3, members, samples, x0, ys, us)
    count = members * samples
    states, filtered, delayed, observers = numbers[: 4 * n * count].reshape(
        4, members, samples, n
    )
    costs, candidates, flags, qps = numbers[4 * n * count : -members * n].reshape(
        4, members, samples
    )
    together = numbers[-members * n :].reshape(members, n)
    for i in range(members):
        mhe.reset(x0[i])
        alone = mhe.update(ys[0, i], us[0, i]).state
        np.testing.assert_allclose(together[i], alone, atol=1e-5)
        mhe.reset(x0[i])
        run = mhe.run(ys[i], us[i])
        np.testing.assert_allclose(states[i], run.states[1:], atol=1e-5)
        np.testing.assert_allclose(filtered[i], run.filtered, atol=1e-5)
        np.testing.assert_allclose(delayed[i], run.delayed, atol=1e-5)
        np.testing.assert_allclose(observers[i], run.observer_states[1:], atol=1e-5)
        np.testing.assert_allclose(costs[i], run.costs, rtol=1e-5, atol=1e-8)
        assert (costs[i] <= candidates[i]).all()
        assert (qps[i] >= 1).all()
        dropped = Status.ROWS_DROPPED.value
        assert ((flags[i].astype(int) ^ run.flags) & dropped == 0).all()


@pytest.mark.parametrize("time", [-1, 1, 6, 10**12])
def test_late_beyond_the_window(time, with_sets):
    mhe = constrained()
    commands, _ = record(mhe, 6, special=False)
    numbers = answers(
        with_sets, mhe.settings, np.zeros(3), *itertools.chain(*commands), 2, time, 0.1, 0.1
    )
    size = 7 + 2 * 5 * 3 + 4 * 3 + 4 * 2 + 6  # of an estimate of a full window
    assert numbers[-size - 1] == -1.0
    assert np.array_equal(numbers[-size:], numbers[-2 * size - 1 : -size - 1])  # as it was


@pytest.mark.parametrize("sets", ["", "disturbances and noises", "states"])
def test_single_precision_is_close(sets, tmp_path):
    options = {"tolerance": 1e-6}
    if sets == "disturbances and noises":
        mhe = constrained(**options)
    else:
        states = {"states": polytope(3, 0.2)} if sets else {}
        mhe = estimator(model(m=1, **states), max_qps=5, **options)
    program = compiled(mhe, tmp_path, real="float")
    commands, expected = record(mhe, 12, spread=0.06)
    for one, other in zip(play(program, mhe, commands), expected, strict=True):
        assert one.cost <= one.candidate_cost
        np.testing.assert_allclose(one.trajectory, other.trajectory, atol=2e-3)
        assert one.cost == pytest.approx(other.cost, rel=1e-2, abs=1e-3)


def test_default_settings_are_all_there_is_of_weights_and_options(tmp_path):
    """Sources of estimators that differ in weights and options only differ in the data only."""
    texts = []
    for name, options in (("a", {"max_qps": 1}), ("b", {"max_qps": None, "seed": 8, "delay": 1})):
        _, source = codegen.write(estimator(model(), **options), tmp_path / name)
        texts.append(source.read_text().split("const mhe_settings mhe_default_settings"))
    assert texts[0][0] == texts[1][0]
    assert texts[0][1] != texts[1][1]


def symbols(path, *options):
    done = subprocess.run(["nm", *options, path], capture_output=True, text=True, check=True)
    return {line.split()[-1] for line in done.stdout.splitlines()}


@pytest.mark.skipif(shutil.which("nm") is None, reason="there is no nm")
@pytest.mark.parametrize("real", ["double", "float"])
def test_exports_its_public_names_and_needs_libm_only(real, tmp_path):
    mhe = estimator(model("MX", m=1, method="rk4", disturbances=polytope(3, 0.1)))
    _, source = codegen.write(mhe, tmp_path, name="reactor", real=real)
    made = tmp_path / "reactor.o"
    subprocess.run(["cc", *STRICT, "-O1", "-c", "-o", made, source], check=True)
    assert symbols(made, "-g", "--defined-only") == {f"reactor_{name}" for name in PUBLIC}
    libm = {"fmax", "fmin", "fabs", "sin", "cos", "sincos", "exp", "log", "log1p"}
    memory = {"memcpy", "memset", "memmove", "_GLOBAL_OFFSET_TABLE_"}
    assert symbols(made, "-u") <= memory | libm | {f"{name}f" for name in libm}
    text = source.read_text()
    assert set(re.findall(r"^#include (.*)", text, re.M)) <= {
        "<math.h>", "<tgmath.h>", "<stddef.h>", "<string.h>", '"reactor.h"'
    }
    declared = set(re.findall(r"\breactor_(\w+)[(;]", (tmp_path / "reactor.h").read_text()))
    assert set(PUBLIC) <= declared


BOTH = r"""
#include "one.h"
#include "two.h"
#include <stdio.h>
static one_estimator a; static one_workspace ka; static one_estimate oa;
static two_estimator b; static two_workspace kb; static two_estimate ob;
int main(void)
{
    const one_real xa[ONE_NX] = {0}, ya[ONE_NY] = {0.3, 0.1};
    const two_real xb[TWO_NX] = {0}, yb[TWO_NY] = {0.3f};
    one_reset(&a, &one_default_settings, xa);
    two_reset(&b, &two_default_settings, xb);
    for (int t = 0; t < 6; t++) {
        one_update(&a, &ka, ya, 0, &oa);
        two_update(&b, &kb, yb, 0, &ob);
    }
    printf("%.17g %.9g\n", oa.trajectory[oa.length * ONE_NX], ob.trajectory[ob.length * TWO_NX]);
    return 0;
}
"""


def test_two_in_one_program_and_from_cpp(tmp_path):
    one, two = estimator(model()), estimator(model(n=2, p=1), horizon=2)
    codegen.write(one, tmp_path, name="one")
    codegen.write(two, tmp_path, name="two", real="float")
    (tmp_path / "both.c").write_text(BOTH)
    command = ["cc", *STRICT, "-o", "both", "both.c", "one.c", "two.c", "-lm"]
    subprocess.run(command, cwd=tmp_path, check=True)
    told = subprocess.run([tmp_path / "both"], capture_output=True, text=True, check=True).stdout
    for _ in range(6):
        expected = one.update([0.3, 0.1]).state[0], two.update([0.3]).state[0]
    assert [float(word) for word in told.split()] == [
        pytest.approx(expected[0], abs=1e-9), pytest.approx(expected[1], abs=1e-5)
    ]
    if shutil.which("c++") is None:
        return
    (tmp_path / "both.cpp").write_text(BOTH)
    for file in ("one", "two"):
        subprocess.run(["cc", *STRICT, "-c", f"{file}.c"], cwd=tmp_path, check=True)
    command = ["c++", "-Wall", "-Wextra", "-pedantic", "-Werror", "-o", "cpp", "both.cpp",
               "one.o", "two.o", "-lm"]
    subprocess.run(command, cwd=tmp_path, check=True)
    again = subprocess.run([tmp_path / "cpp"], capture_output=True, text=True, check=True).stdout
    assert again == told


@pytest.mark.parametrize(
    "name", ["mhe_tank", "MHE_tank", "MHE", "casadi", "real", "size", 60 * "a"]
)
def test_names(name, tmp_path):
    mhe = estimator(model(n=1, p=1, disturbances=box(1, 5.0)), horizon=2)
    program = compiled(mhe, tmp_path, [*STRICT, "-O0"], name=name)
    commands, expected = record(mhe, 3, special=False)
    check(play(program, mhe, commands), expected, 1e-6, statuses=False)
    comment = (tmp_path / f"{name}.h").read_text().split("*/")[0]
    assert f"{name}.c with" in comment
    assert f"{name}_update(&estimator" in comment
    assert shutil.which("c++") is None or subprocess.run(
        ["c++", "-Werror", "-fsyntax-only", "-x", "c++", tmp_path / f"{name}.h"], check=False
    ).returncode == 0


BAD = {
    "no identifier": ({"name": "9a"}, OptionError, "name is '9a'"),
    "hyphen": ({"name": "a-b"}, OptionError, "name is 'a-b'"),
    "empty": ({"name": ""}, OptionError, "name is ''"),
    "line end": ({"name": "a\n"}, OptionError, "name is"),
    "not ASCII": ({"name": "\u00e9tat"}, OptionError, "name is"),
    "no name": ({"name": None}, OptionError, "name is None"),
    "path": ({"name": "../a"}, OptionError, "name is"),
    "real": ({"real": "half"}, OptionError, "real is 'half'.*'double' or 'float'"),
    "list": ({"real": ["float"]}, OptionError, "real is"),
    "math.h": ({"name": "math"}, OptionError, "<math.h> is a header of the system.*'mhe_math'"),
    "string.h": ({"name": "string"}, OptionError, "<string.h> is a header"),
    "Stdint.h": ({"name": "Stdint"}, OptionError, "<stdint.h> is a header"),
    "features.h": ({"name": "features"}, OptionError, "<features.h> is a header"),
    "long": ({"name": 300 * "a"}, OptionError, "name has 300 letters; expected at most 60"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_options(case, tmp_path):
    options, error, text = BAD[case]
    with pytest.raises(error, match=text):
        codegen.write(estimator(model()), tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("directory", ["file", "file/below", "null\0byte", None, 3])
def test_bad_directories(directory, tmp_path):
    (tmp_path / "file").write_text("")
    place = tmp_path / directory if isinstance(directory, str) else directory
    with pytest.raises(InvalidInputError, match="directory is"):
        codegen.write(estimator(model()), place)


def test_directories_are_made_and_files_replaced(tmp_path):
    folder = tmp_path / "a" / "b"
    first = codegen.write(estimator(model()), str(folder))
    texts = [path.read_text() for path in first]
    codegen.write(estimator(model(m=1)), folder)
    assert [path.read_text() for path in first] != texts
    assert sorted(path.name for path in folder.iterdir()) == ["mhe.c", "mhe.h"]


class OwnCost(qpmhe.QuadraticCost):
    """May weigh in another way."""


class OwnGain(qpmhe.Luenberger):
    """Corrects in another way."""

    def correct(self, z, v, sample):
        correction, covariance = super().correct(z, v, sample)
        return 0.5 * correction, covariance


def without_form(case):
    branching = qpmhe.System(
        lambda x: 0.9 * x if float(x[0]) > 9.0 else x, lambda x: x[:1], n=3, p=1
    )
    system, n = model(p=1), 3
    gain, weights = np.full((3, 1), 0.1), {"prior": np.eye(n), "disturbance": np.eye(n)}
    parts = [system, qpmhe.Luenberger(gain), qpmhe.QuadraticCost(**weights, noise=1.0)]
    options = {}
    if case == "from_casadi":
        parts[0] = branching
    elif case == "of qpmhe's own":
        parts[1] = OwnGain(gain)
    elif case == "QuadraticCost":
        parts[2] = OwnCost(**weights, noise=1.0)
    elif case == "backend='auto'":
        options["backend"] = "osqp"
    return qpmhe.MovingHorizonEstimator(
        *parts, horizon=2, initial_state=np.zeros(3), **options
    )


@pytest.mark.parametrize("remedy", [
    "from_casadi", "of qpmhe's own", "QuadraticCost", "backend='auto'",
])
def test_what_has_no_c_form_tells_the_remedy(remedy, tmp_path):
    with pytest.raises(OptionError, match=remedy):
        codegen.write(without_form(remedy), tmp_path)
    assert not list(tmp_path.iterdir())


def test_no_estimator(tmp_path):
    with pytest.raises(InvalidInputError, match="estimator is"):
        codegen.write(model(), tmp_path)


def test_functions_without_code_are_refused(tmp_path):
    """CasADi writes an #error in their place."""
    z, q, x = ca.SX.sym("z"), ca.SX.sym("q"), ca.MX.sym("x", 2)
    root = ca.rootfinder("root", "newton", {"x": z, "p": q, "g": z + 0.1 * ca.sin(z) - q})
    system = qpmhe.from_casadi(
        ca.Function("f", [x], [ca.vertcat(root(0, x[0]), 0.5 * x[1])]),
        ca.Function("h", [x], [x[0]]), compiled=False,
    )
    with pytest.raises(QpmheError, match="code"):
        codegen.write(estimator(system), tmp_path)


@pytest.mark.parametrize(
    ("options", "real"), [({"max_qps": 2**40}, "double"), ({"tolerance": 1e300}, "float")]
)
def test_numbers_that_c_cannot_hold(options, real, tmp_path):
    mhe = estimator(model(), **options)
    try:
        codegen.write(mhe, tmp_path, real=real)
    except QpmheError:
        return
    mhe_c = (tmp_path / "mhe.c").read_text()
    assert ".max_qps = 0" not in mhe_c


MATRIX_MODELS = {
    "log-sum-exp": lambda x: 0.5 * x + 0.1 * ca.logsumexp(x),
    "spline": lambda x: 0.5 * x + 0.1 * ca.interpolant(
        "s", "bspline", [np.linspace(-3, 3, 9)], np.sin(np.linspace(-3, 3, 9)))(x[0]),
    "linear system": lambda x: ca.solve(ca.MX(ca.DM([[2.0, 0.3], [0.1, 2.0]])), x + ca.sin(x)),
}


@pytest.mark.parametrize("case", MATRIX_MODELS)
def test_matrix_expressions(case, tmp_path):
    x = ca.MX.sym("x", 2)
    system = qpmhe.from_casadi(
        ca.Function("f", [x], [MATRIX_MODELS[case](x)]),
        ca.Function("h", [x], [x[0] + 0.1 * x[1] ** 2]), compiled=False,
    )
    mhe = estimator(system, max_qps=2)
    compiled(mhe, tmp_path, [*STRICT, "-O2"])
    program = compiled(mhe, tmp_path, [*WATCHED, *STRICT])
    commands, expected = record(mhe, 6)
    check(play(program, mhe, commands), expected, 1e-9)


def test_a_time_budget_needs_a_clock(tmp_path):
    """Without one, all QPs are solved."""
    system = model(noises=box(2, 0.5))
    mhe = estimator(system, max_qps=3, time_budget=1e-9)
    compiled(mhe, tmp_path, [*STRICT, "-O2"])
    program = compiled(mhe, tmp_path, [*WATCHED, *STRICT])
    commands, expected = record(estimator(system, max_qps=3), 12)
    check(play(program, mhe, commands), expected, 1e-5)
    assert "clock" in (tmp_path / "mhe.h").read_text()


def test_what_does_not_fit_into_c_is_refused(tmp_path):
    def made(n, horizon):
        system = qpmhe.from_casadi(lambda x: 0.9 * x, lambda x: x[0], n=n)
        cost = qpmhe.QuadraticCost(prior=np.eye(n), disturbance=np.eye(n), noise=[[1.0]])
        return qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger(np.zeros(n)), cost, horizon=horizon,
            initial_state=np.ones(n), max_qps=0,
        )

    large = made(257, 1)
    with pytest.raises(QpmheError, match=r"257 states; .* at most 256"):
        codegen.write(large, tmp_path)
    assert large.system.symbolic is not None  # CasADi evaluates it instead
    large = made(50, 2)
    with pytest.raises(OptionError, match=r"a horizon of 800000 with 50 states .* shorter one"):
        generated(
            large.system, large.observer, large.cost,
            dataclasses.replace(large.settings, horizon=800000),
        )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("discount", "real"), [(0.5, "float"), (0.01, "double")])
def test_failed_stages_whose_discount_underflows(discount, real, tmp_path):
    """Zero times infinity: the cost of such a window is infinite, not NaN."""
    x = ca.SX.sym("x", 1)
    system = qpmhe.from_casadi(
        ca.Function("f", [x], [0.9 * x]), ca.Function("h", [x], [ca.sqrt(x)]), compiled=False
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.5]),
        qpmhe.QuadraticCost(prior=1.0, disturbance=5.0, noise=5.0, discount=discount),
        horizon=190, initial_state=[0.5],
    )
    program = compiled(mhe, tmp_path, [*WATCHED, *STRICT], real=real)
    ys = 0.3 + 0.01 * np.sin(np.arange(220.0))
    ys[5] = -40.0
    estimates = play(program, mhe, [(0, [y]) for y in ys], mhe.settings)
    smallest = np.float32 if real == "float" else np.float64
    assert smallest(discount) ** 185 == 0
    failed = [Status.FAILED_STAGE in e.status for e in estimates]
    assert sum(failed) == 189
    for estimate, has_failed in zip(estimates, failed, strict=True):
        assert estimate.cost <= estimate.candidate_cost
        assert np.isinf(estimate.candidate_cost) == has_failed or (
            Status.MODEL_FAILED in estimate.status
        )
