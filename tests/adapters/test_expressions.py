"""Models of JAX, SymPy and python-control as CasADi expressions."""

import numpy as np
import pytest

import qpmhe

jax = pytest.importorskip("jax")
jnp = pytest.importorskip("jax.numpy")

generator = np.random.default_rng(0)
W, V = generator.normal(size=(4, 2)), generator.normal(size=(2, 4))
TABLE = np.array([0.5, -1.0, 2.0])


def scanned(x):
    return jax.lax.scan(lambda c, k: (0.9 * c + 0.1 * jnp.sin(k * c), c), x, TABLE)[0]


def shuffled(x):
    return jnp.concatenate([x[::-1], x]).reshape(2, 2).T[jnp.array([1, 0]), 1] * TABLE[:2]


EXPRESSIONS = {
    "affine": lambda x: x + 0.1 * V @ (W @ x),
    "network": lambda x: V @ jnp.tanh(W @ x) + jax.nn.sigmoid(x) + jax.nn.softplus(x),
    "list": lambda x: [x[1], -jnp.sin(x[0])],
    "where": lambda x: jnp.where(x > 0.0, x, jnp.exp(x) - 1.0),
    "clip": lambda x: jnp.clip(x, -1.0, 1.0) + jax.nn.relu(x),
    "at": lambda x: (2.0 * x).at[0].set(x[1] ** 3),
    "norm": lambda x: x / (1.0 + jnp.linalg.norm(x)) + jnp.sum(x) + jnp.max(x) - jnp.prod(x),
    "shuffled": shuffled,
    "einsum": lambda x: jnp.einsum("i,ij,j->", x, W[:2], x) * x,
    "remainder": lambda x: jnp.mod(x, 0.7) + jnp.arctan2(x, x[::-1]) + jnp.cumsum(x),
    "scan": scanned,
    "fori": lambda x: jax.lax.fori_loop(0, 4, lambda i, c: 0.9 * c + 0.01 * i, x),
    "cond": lambda x: jax.lax.cond(x[0] > 0.0, lambda a: a, lambda a: 2.0 * a, x),
    "jit": jax.jit(lambda x: jnp.sqrt(1.0 + x * x)),
}


@pytest.mark.parametrize("name", EXPRESSIONS)
def test_a_jax_model_is_the_expression(name):
    system = qpmhe.from_jax(EXPRESSIONS[name], lambda x: x[0] * x[1], n=2, p=1)
    assert system.derivatives == {"f": "jax", "h": "jax"}
    model = system.symbolic
    assert model is not None, system.no_symbolic
    for x in 3.0 * generator.normal(size=(20, 2)):
        np.testing.assert_allclose(
            np.array(model.f(x, []))[:, 0], system.f(x, np.zeros(0)), rtol=1e-12, atol=1e-14
        )


NONE = {
    "while": (lambda x: jax.lax.while_loop(lambda c: c[0] > 1.0, lambda c: 0.5 * c, x), "while"),
    "a look-up": (lambda x: jnp.asarray(TABLE)[jnp.int32(jnp.abs(x[0])) % 3] * x, "int32"),
    "sorting": (jnp.sort, "sort"),
    "a long loop": (
        lambda x: jax.lax.fori_loop(0, 5000, lambda i, c: 0.999 * c, x), "loop of 5000 turns"
    ),
}


@pytest.mark.parametrize("name", NONE)
def test_a_jax_model_without_an_expression_says_why(name):
    function, word = NONE[name]
    system = qpmhe.from_jax(function, lambda x: x, n=2, p=2)
    assert system.symbolic is None
    assert word in system.no_symbolic
    assert f"f: not traced: its operation {word}" in system.explain() or word in system.explain()


def rate(x, u):
    return jnp.array([x[1], u[0] - jnp.sin(x[0])])


def test_a_rate_of_jax_keeps_its_steps():
    system = qpmhe.from_jax(rate, lambda x: x[0], n=2, p=1, m=1, dt=0.1)
    model = system.symbolic
    assert (model.dt, model.method, model.m) == (0.1, "rk4", 1)
    x, u = np.array([0.3, -0.2]), np.array([0.7])
    np.testing.assert_allclose(
        np.array(model.step()(x, u, 0.1))[:, 0], system.f(x, u), rtol=1e-14
    )


def test_a_jax_model_takes_the_compiled_step():
    runs = []
    for engine in ("python", "compiled"):
        system = qpmhe.from_jax(rate, lambda x: x[0], n=2, p=1, m=1, dt=0.1)
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.4, 0.3]),
            qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=1.0), horizon=5,
            initial_state=[1.0, 0.0], engine=engine,
        )
        assert mhe.engine == engine
        ys = np.random.default_rng(1).normal(size=(20, 1))
        runs.append(mhe.run(ys, np.ones((20, 1))).states)
    np.testing.assert_allclose(*runs, rtol=1e-9, atol=1e-10)


def test_a_sympy_model_is_traced():
    sympy = pytest.importorskip("sympy")
    a, b, u = sympy.symbols("a b u")
    system = qpmhe.from_sympy(
        [b, u - sympy.sin(a)], [sympy.Piecewise((a, a > 0), (sympy.exp(a) - 1, True))], [a, b], [u],
        dt=0.1,
    )
    assert system.derivatives == {"f": "traced", "h": "traced"}
    assert system.symbolic.dt == 0.1


@pytest.mark.parametrize("method", ["zoh", "rk4"])
def test_a_linear_model_of_control_is_traced(method):
    control = pytest.importorskip("control")
    plant = control.ss([[0.0, 1.0], [-1.0, -0.3]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]])
    system = qpmhe.from_control(plant, dt=0.1, method=method)
    assert system.derivatives == {"f": "traced", "h": "traced"}
    assert system.symbolic is not None


def test_a_nonlinear_model_of_control_is_traced():
    control = pytest.importorskip("control")
    plant = control.NonlinearIOSystem(
        lambda t, x, u, params: np.array([x[1], u[0] - np.sin(x[0])]),
        lambda t, x, u, params: x[0], states=2, inputs=1, outputs=1,
    )
    system = qpmhe.from_control(plant, dt=0.1)
    assert system.derivatives["f"] == "traced", system.explain()
