"""What only JAX's models have: tracing, precision, compiled programs, indices, expressions."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError, ModelError, OptionError, SetError
from tests.adapters.twins import FUNCTIONS, NONE, by_jax, by_numpy, points, same

jax = pytest.importorskip("jax")
jnp = jax.numpy

from qpmhe import from_jax  # noqa: E402 - behind what it needs

HOME = jax if hasattr(jax, "enable_x64") else jax.experimental
SWITCH = HOME.enable_x64


def estimator(system, **options):
    n, p = system.n, system.p
    cost = qpmhe.QuadraticCost(prior=np.eye(n), disturbance=np.eye(n), noise=100.0 * np.eye(p))
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(np.full((n, p), 0.3)), cost,
        **{"horizon": 4, "initial_state": np.ones(n), **options},
    )


@pytest.mark.parametrize("double", [False, True])
def test_results_are_double_and_the_precision_of_the_process_is_left_alone(double):
    third = np.array([1.0 / 3.0])
    with SWITCH(double):
        system = from_jax(lambda x: x + 1e-12, lambda x: jnp.exp(x), n=1, p=1)
        assert system.f(third, NONE)[0] == third[0] + 1e-12
        with pytest.raises(ModelError):
            from_jax(lambda x: x[0, 0, 0], lambda x: x, n=1, p=1)
        assert jax.config.jax_enable_x64 is double
    with SWITCH(not double):  # made under one default, used under the other
        assert system.f(2.0 * third, NONE)[0] == 2.0 * third[0] + 1e-12
        found = system.h.batch(np.tile(third, (20, 1)), np.empty((20, 0)))
        np.testing.assert_allclose(found, math.exp(1.0 / 3.0), rtol=1e-15)
        assert jnp.ones(1).dtype == (np.float32 if double else np.float64)


def test_a_large_model_over_a_long_window():
    weights = np.random.default_rng(1).standard_normal((24, 30)) / 5.0

    def network(xp, x):
        hidden = xp.tanh(xp.tanh(x @ weights[:, :6].T) @ weights[:, 6:].T)
        return 0.9 * x + hidden @ weights[:, :6]

    one = from_jax(lambda x: network(jnp, x), lambda x: x[:2], n=6, p=2)
    two = qpmhe.System(lambda x: network(np, x), lambda x: x[..., :2], n=6, p=2)
    xs = 0.5 * np.random.default_rng(2).standard_normal((40, 6))
    same(one, two, xs, np.empty((40, 0)), 1e-11)
    found, expected = (
        estimator(each, horizon=20, max_qps=1).update(xs[0, :2]) for each in (one, two)
    )
    np.testing.assert_allclose(found.trajectory, expected.trajectory, rtol=1e-8, atol=1e-9)


def test_calls_of_a_step_and_estimators_that_share_programs(monkeypatch):
    calls = []
    # Entries of the switch to double precision: one at each call into a program.
    monkeypatch.setattr(HOME, "enable_x64", lambda value: calls.append(value) or SWITCH(value))
    system = from_jax(lambda x: 0.9 * x, lambda x: x[:1] ** 2, n=2, p=1)
    ys = 1.0 + 0.1 * np.random.default_rng(8).standard_normal((40, 1))
    for max_qps in (0, 1):
        mhe = estimator(system, max_qps=max_qps)
        for y in ys[:20]:
            mhe.update(y)
        calls.clear()
        assert sum(mhe.update(y).improved for y in ys[20:]) == 20 * max_qps
        # The new stage, the trial, and now and then a batch to see that batches may be trusted.
        assert 20 * (1 + max_qps) <= len(calls) <= 20 * (1 + max_qps) + 2
    compiled = []
    monkeypatch.setattr(
        "qpmhe.adapters.jax_programs.Programs._compiled", lambda *given: compiled.append(given)
    )
    assert estimator(system).update([2.5]).improved
    assert compiled == []


def callback(x):
    return jax.pure_callback(np.asarray, jax.ShapeDtypeStruct((2,), np.float64), x)


WRONG = [
    (lambda x: jnp.ones(3), r"f returned shape \(3,\); expected \(2,\)"),
    (lambda x: x if x[0] > 0 else -x, "JAX cannot trace f: TracerBool"),
    (lambda x: x * math.sin(x[0]), "JAX cannot trace f: .*jnp.where or lax.cond"),
    (lambda x: x.astype(jnp.float32), "f returned float32 where x is float64"),
    (lambda x, u: x + u, "f needs 2 arguments, but the system has no inputs"),
    (3.0, "f is 3.0; expected a function"),
    (callback, "JAX cannot differentiate f and h: "),
]


@pytest.mark.parametrize(("f", "words"), WRONG)
def test_a_function_that_cannot_be_used_is_refused_in_words(f, words):
    for dt in (None, 0.1):
        with pytest.raises(ModelError, match=words):
            from_jax(f, lambda x: x[:1], n=2, p=1, dt=dt)


def test_wrong_options_and_a_missing_cpu_are_refused(monkeypatch):
    for options, error, words in [
        ({"n": 0}, OptionError, "n is 0"), ({"dt": 0.0}, OptionError, "dt is 0.0"),
        ({"method": "heun"}, OptionError, "method is 'heun'"),
        ({"states": qpmhe.Box([0.0], [1.0])}, SetError, "states has dimension 1"),
    ]:
        with pytest.raises(error, match=words):
            from_jax(lambda x: x, lambda x: x[:1], **{"n": 2, "p": 1, **options})

    def none(backend):
        raise RuntimeError(f"Unknown backend {backend}")

    monkeypatch.setattr(jax, "local_devices", none)
    with pytest.raises(InvalidInputError, match=r"Unknown backend cpu.*JAX_PLATFORMS"):
        from_jax(lambda x: x, lambda x: x, n=1, p=1)


def test_a_wrong_derivative_is_refused_and_a_kink_is_not():
    @jax.custom_jvp
    def squared(x):
        return x**2

    squared.defjvp(lambda x, dx: (x[0] ** 2, 3.0 * x[0] * dx[0]))
    with pytest.raises(ModelError, match=r"f_jacobian\[0, 0\] is .* It is JAX's: look for"):
        from_jax(squared, lambda x: x, n=1, p=1).model([1.0])
    with pytest.raises(ModelError, match=r"h_jacobian.* custom derivative within h"):
        from_jax(lambda x: x, squared, n=1, p=1).model([1.0])
    # Differences across it give the mean of both slopes, JAX one of them.
    bent = from_jax(
        lambda x: jnp.where(x > 1.0, 0.9 * x, 0.6 + 0.3 * x), lambda x, u: x + u, n=1, p=1, m=1
    )
    assert estimator(bent, initial_state=[1.0]).update([1.5], [0.0]).improved
    assert bent.f_jacobian(np.ones(1), np.ones(1))[0, 0] in (0.3, 0.9)


# Indices out of range, where JAX reads another entry


TABLE = np.linspace(0.0, 1.0, 8)


def place(x):
    return (8.0 * x[0]).astype(int)


def loop(x, turns):
    return jax.lax.fori_loop(0, turns, lambda i, total: total + x[i], 0.0) * x


OUT_OF_RANGE = {
    "positive": (lambda x, u: x * x[5], "index 5 on axis 0, of size 2, of an array (2,)"),
    "negative": (lambda x, u: x * x[-3], "index -3 on axis 0, of size 2"),
    "input": (lambda x, u: x * u[1], "index 1 on axis 0, of size 1, of an array (1,)"),
    "table": (lambda x, u: x * jnp.asarray(TABLE)[place(10.0 * x)], "on axis 0, of size 8"),
    "write": (lambda x, u: x.at[2].set(1.0), "index 2 on axis 0, of size 2"),
    "loop": (lambda x, u: loop(x, 3), "index 2 on axis 0, of size 2"),
    "vmap": (lambda x, u: x * jax.vmap(lambda i: x[i])(jnp.arange(3))[2], "index 2 on axis 0"),
    "in a branch": (
        lambda x, u: jax.lax.cond(u[0] > 0.0, lambda: x * x[5], lambda: x), "index 5 on axis 0"
    ),
}
IN_RANGE = {
    "turned": lambda x, u: x[::-1] + x[0:9],
    "write": lambda x, u: x.at[-1].set(1.0).at[:1].add(u),
    "clipped": lambda x, u: x * jnp.asarray(TABLE)[jnp.clip(place(x), 0, 7)],
    "clip in a loop": lambda x, u: jax.lax.fori_loop(
        0, 4, lambda i, z: 0.5 * z + jnp.take(x, i, mode="clip"), x
    ),
    "wrap": lambda x, u: x * jnp.take(jnp.asarray(TABLE), place(x), mode="wrap"),
    "filled": lambda x, u: x * jnp.asarray(TABLE).at[place(x)].get(mode="fill", fill_value=0.5),
    "clipped write": lambda x, u: x.at[place(x)].set(1.0, mode="clip"),
    "interpolation": lambda x, u: x * jnp.interp(x[0], jnp.asarray(TABLE), jnp.asarray(TABLE)),
    "solved": lambda x, u: jnp.linalg.solve(jnp.eye(2) + jnp.outer(x, x), x),
    "guarded by a branch": lambda x, u: jax.lax.cond(u[0] < 0.0, lambda: x * x[5], lambda: x),
}


@pytest.mark.parametrize("name", OUT_OF_RANGE)
def test_an_index_out_of_range_is_refused(name):
    function, words = OUT_OF_RANGE[name]
    for f, h, p, which in (
        (function, lambda x: x[0], 1, "f"), (lambda x: x, lambda x, u: function(x, u), 2, "h")
    ):
        with pytest.raises(ModelError, match=rf"^{which} uses index .*jnp\.clip") as caught:
            from_jax(f, h, n=2, p=p, m=1, dt=0.1 if which == "f" else None)
        assert words in str(caught.value)


@pytest.mark.parametrize("name", IN_RANGE)
def test_indices_in_range_or_with_a_meaning_are_taken(name):
    function = IN_RANGE[name]
    system = from_jax(function, lambda x: x[0], n=2, p=1, m=1)
    x, u = np.array([0.4, 0.7]), np.array([0.2])
    with SWITCH(True):
        np.testing.assert_allclose(system.f(x, u), np.asarray(jax.jit(function)(x, u)), rtol=1e-12)


def test_indices_are_checked_within_the_set_of_states():
    inside = qpmhe.Box([0.0, 0.0], [0.09, 0.9])
    assert from_jax(OUT_OF_RANGE["table"][0], lambda x: x[0], n=2, p=1, m=1, states=inside).n == 2


# As CasADi expressions, for the compiled step and the certificates


generator = np.random.default_rng(0)
W, V = generator.normal(size=(4, 2)), generator.normal(size=(2, 4))
TURNS = np.array([0.5, -1.0, 2.0])


def scanned(x):
    return jax.lax.scan(lambda c, k: (0.9 * c + 0.1 * jnp.sin(k * c), c), x, TURNS)[0]


def shuffled(x):
    return jnp.concatenate([x[::-1], x]).reshape(2, 2).T[jnp.array([1, 0]), 1] * TURNS[:2]


EXPRESSIONS = {
    "network": lambda x: V @ jnp.tanh(W @ x) + jax.nn.sigmoid(x) + jax.nn.softplus(x),
    "where": lambda x: jnp.where(x > 0.0, x, jnp.exp(x) - 1.0),
    "at": lambda x: (2.0 * x).at[0].set(x[1] ** 3),
    "norm": lambda x: x / (1.0 + jnp.linalg.norm(x)) + jnp.sum(x) + jnp.max(x) - jnp.prod(x),
    "shuffled": shuffled,
    "einsum": lambda x: jnp.einsum("i,ij,j->", x, W[:2], x) * x,
    "remainder": lambda x: jnp.mod(x, 0.7) + jnp.arctan2(x, x[::-1]) + jnp.cumsum(x),
    "scan": scanned,
    "cond": lambda x: jax.lax.cond(x[0] > 0.0, lambda a: a, lambda a: 2.0 * a, x),
}
WITHOUT = {
    "while": (lambda x: jax.lax.while_loop(lambda c: c[0] > 1.0, lambda c: 0.5 * c, x), "while"),
    "a look-up": (lambda x: jnp.asarray(TURNS)[jnp.int32(jnp.abs(x[0])) % 3] * x, "int32"),
    "sorting": (jnp.sort, "sort"),
}


@pytest.mark.parametrize("name", EXPRESSIONS)
def test_a_jax_model_is_the_expression(name):
    system = from_jax(EXPRESSIONS[name], lambda x: x[0] * x[1], n=2, p=1)
    model = system.symbolic
    assert model is not None, system.no_symbolic
    for x in 3.0 * generator.normal(size=(20, 2)):
        np.testing.assert_allclose(
            np.array(model.f(x, []))[:, 0], system.f(x, NONE), rtol=1e-12, atol=1e-14
        )


@pytest.mark.parametrize("name", WITHOUT)
def test_a_jax_model_without_an_expression_says_why(name):
    function, word = WITHOUT[name]
    system = from_jax(function, lambda x: x, n=2, p=2)
    assert system.symbolic is None
    assert word in system.no_symbolic
    assert word in system.explain()


# Implicit steps, and substeps


@pytest.mark.parametrize("options", [
    {"method": "radau"}, {"method": "midpoint", "steps": 2}, {"method": "rk4", "steps": 3},
    {"method": "auto", "tolerance": 1e-4},
], ids=lambda one: one["method"])
def test_steps_that_jax_does_not_compute_are_those_of_the_rate(options):
    mine, theirs = by_jax(dt=0.1, **options), by_numpy(dt=0.1, **options)
    assert (mine.method, mine.steps) == (theirs.method, theirs.steps)
    assert mine.symbolic is not None, mine.no_symbolic
    xs, us = points(3)
    same(mine, theirs.model().functions, xs, us, 1e-7)
    for one, other in ((mine, theirs), (mine.timed, theirs.timed)):
        inputs = us if one is mine else np.column_stack((us, [0.05, 0.1, 0.2]))
        exact = other.model().functions
        for name in FUNCTIONS:
            np.testing.assert_allclose(
                getattr(one.model().functions, name).batch(xs, inputs),
                getattr(exact, name).batch(xs, inputs), rtol=1e-9, atol=1e-11,
            )


def test_an_implicit_step_of_a_rate_without_an_expression():
    """Values and derivatives by JAX's programs alone, through an estimator and a copy."""
    def rate(x):
        top = jax.lax.while_loop(lambda c: c[0] < 0.0, lambda c: c + 1.0, 0.0 * x)
        return jnp.array([-50.0 * (x[0] - jnp.cos(x[1])), 1.0 - x[0] * x[1]]) + top

    options = {"n": 2, "p": 1, "dt": 0.1, "method": "radau"}
    mine = from_jax(rate, lambda x: x[0], **options)
    assert mine.symbolic is None
    assert "while" in mine.no_symbolic
    plain = qpmhe.System.from_ode(
        lambda x: np.stack(
            [-50.0 * (x[..., 0] - np.cos(x[..., 1])), 1.0 - x[..., 0] * x[..., 1]], axis=-1
        ),
        lambda x: x[..., 0], **options,
    ).model().functions
    for x in np.random.default_rng(0).normal(size=(4, 2)):
        for name in FUNCTIONS:
            found, expected = (getattr(one, name)(x, NONE) for one in (mine, plain))
            np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-13)
    assert "jax" in mine.derivatives["f"]
    augmented = qpmhe.augment_parameters(
        from_jax(lambda x, u: rate(x) + u[0], lambda x, u: x[0], m=1, **options), nominal=[0.0]
    )
    assert (augmented.method, augmented.n) == ("radau", 3)
    expected = np.append(mine.f(x), 0.0)
    np.testing.assert_allclose(augmented.f(np.append(x, 0.0)), expected, atol=1e-12)


@pytest.mark.parametrize(("options", "words"), [
    ({"method": "radau"}, "method is 'radau', but dt is missing"),
    ({"method": "auto"}, "method is 'auto', but dt is missing"),
    ({"steps": 3}, "steps is 3, but dt is missing"),
    ({"dt": 0.1, "method": "auto", "steps": 2}, "leave steps out"),
    ({"dt": 0.1, "tolerance": 1e-3}, "tolerance is 0.001, but method is 'rk4'"),
])
def test_bad_options_of_steps(options, words):
    with pytest.raises(OptionError, match=words):
        from_jax(lambda x: -x, lambda x: x, n=1, p=1, **options)
