import math

import numpy as np
import pytest

import qpmhe

from .plain import Record
from .ways import NONE, PENDULUMS, check_values, pendulum


@pytest.mark.parametrize("way", PENDULUMS)
def test_every_way_of_writing_f_gives_equal_values(way):
    f, mode = PENDULUMS[way]
    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)
    assert system.f.mode == mode
    check_values(system.f, pendulum, 2)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
@pytest.mark.parametrize(
    ("write", "mode"),
    [
        pytest.param(lambda a: lambda x: a @ x, "columns", id="A @ x"),
        pytest.param(lambda a: lambda x: np.dot(a, x), "columns", id="dot(A, x)"),
        pytest.param(lambda a: lambda x: x @ a.T, "batched", id="x @ A.T"),
        pytest.param(lambda a: lambda x: np.inner(x, a), "batched", id="inner(x, A)"),
        pytest.param(lambda a: lambda x: np.inner(a, x), "looped", id="inner(A, x)"),
        pytest.param(
            lambda a: lambda x: np.einsum("ij,...j->...i", a, x), "batched", id="einsum"
        ),
        pytest.param(lambda a: lambda x: np.linalg.solve(np.linalg.inv(a), x), None, id="solve"),
    ],
)
def test_linear_maps(n, write, mode):
    a = np.random.default_rng(n).standard_normal((n, n)) + 2.0 * np.eye(n)
    system = qpmhe.System(write(a), lambda x: x[..., :1], n=n, p=1)
    if mode is not None and n > 1:
        assert system.f.mode == mode
    check_values(system.f, lambda x, u: a @ x, n)


@pytest.mark.parametrize(
    "write",
    [
        pytest.param(lambda a: lambda x: (a @ x.T).T, id="(A @ x.T).T"),
        pytest.param(lambda a: lambda x: np.dot(a, x.T).T, id="dot(A, x.T).T"),
        pytest.param(
            lambda a: lambda x: np.stack([row @ x.T for row in a], axis=-1), id="stacked rows"
        ),
    ],
)
def test_functions_right_on_one_leading_dimension_only(write):
    a = np.array([[1.0, 0.1], [-0.2, 0.9]])
    system = qpmhe.System(write(a), lambda x: x[..., :1], n=2, p=1)
    check_values(system.f, lambda x, u: a @ x, 2)


CONSTANTS = {
    "constant component": (lambda x: np.array([x[1], 1.5]), lambda x: [x[1], 1.5]),
    "constant first": (lambda x: [1.5, x[0]], lambda x: [1.5, x[0]]),
    "only constants": (lambda x: np.array([1.0, 2.0]), lambda x: [1.0, 2.0]),
    "added vector": (
        lambda x: np.array([x[1], -x[0]]) + np.array([1.0, 2.0]),
        lambda x: [x[1] + 1.0, -x[0] + 2.0],
    ),
    "scaled by a vector": (
        lambda x: np.array([1.0, 2.0]) * np.array([x[1], -x[0]]),
        lambda x: [x[1], -2.0 * x[0]],
    ),
    "added ones": (
        lambda x: np.array([x[1], -x[0]]) + np.ones(2), lambda x: [x[1] + 1.0, -x[0] + 1.0]
    ),
    "times a multiple of the identity": (
        lambda x: 0.5 * np.eye(2) @ x, lambda x: [0.5 * x[0], 0.5 * x[1]]
    ),
    "zeros like a component": (lambda x: np.array([x[1], 0.0 * x[0]]), lambda x: [x[1], 0.0]),
    "identity": (lambda x: x, lambda x: x),
    "integers": (lambda x: np.array([1, 2]), lambda x: [1, 2]),
}


@pytest.mark.parametrize("case", CONSTANTS)
def test_constants_within_values(case):
    f, plain = CONSTANTS[case]
    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)
    check_values(system.f, lambda x, u: np.array(plain(x), dtype=float), 2)


@pytest.mark.parametrize(
    "f",
    [
        pytest.param(lambda x: x / np.linalg.norm(x), id="norm"),
        pytest.param(lambda x: x - np.mean(x), id="mean"),
        pytest.param(lambda x: x * np.max(x), id="max"),
        pytest.param(lambda x: np.cumsum(x), id="cumsum"),
        pytest.param(lambda x: x[::-1], id="reversed"),
        pytest.param(lambda x: np.roll(x, 1), id="roll"),
        pytest.param(lambda x: np.sort(x), id="sort"),
    ],
)
def test_functions_that_mix_what_they_should_not_on_many_states(f):
    system = qpmhe.System(f, lambda x: x[..., :1], n=3, p=1)
    check_values(system.f, lambda x, u: f(x), 3)


def test_a_function_that_reuses_its_output_array():
    buffer = np.zeros(2)

    def f(x):
        buffer[0], buffer[1] = x[1], -x[0]
        return buffer

    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)
    check_values(system.f, lambda x, u: np.array([x[1], -x[0]]), 2)


SCALARS = {
    "x[0]": lambda x: x[0],
    "x[..., 0]": lambda x: x[..., 0],
    "x[:1]": lambda x: x[:1],
    "x[..., :1]": lambda x: x[..., :1],
    "array": lambda x: np.array([x[0]]),
    "list": lambda x: [x[0]],
    "float": lambda x: float(x[0]),
    "math": lambda x: math.sqrt(x[0]) ** 2,
    "c @ x": lambda x: np.eye(x.shape[0])[0] @ x,
}


@pytest.mark.parametrize("n", [1, 2, 4])
@pytest.mark.parametrize("way", SCALARS)
def test_a_single_output_may_be_a_scalar(way, n):
    system = qpmhe.System(lambda x: x, SCALARS[way], n=n, p=1)
    check_values(system.h, lambda x, u: x[:1], n)


@pytest.mark.parametrize(
    ("h", "plain"),
    [
        pytest.param(np.sum, sum, id="sum"),
        pytest.param(lambda x: x @ np.array([1.0, 2.0]), lambda x: x[0] + 2 * x[1], id="x @ c"),
        pytest.param(lambda x: np.array([1.0, 2.0]) @ x, lambda x: x[0] + 2 * x[1], id="c @ x"),
        pytest.param(np.linalg.norm, lambda x: math.hypot(*x), id="norm"),
        pytest.param(lambda x: 3.0, lambda x: 3.0, id="constant"),
        pytest.param(lambda x: x[1] * x[0], lambda x: x[0] * x[1], id="product"),
    ],
)
def test_scalar_outputs_of_all_states(h, plain):
    system = qpmhe.System(lambda x: x, h, n=2, p=1)
    check_values(system.h, lambda x, u: np.array([plain(x)]), 2)


@pytest.mark.parametrize(
    "f",
    [
        pytest.param(lambda x: np.sin(x), id="sin(x)"),
        pytest.param(lambda x: np.sin(x[0]), id="sin(x[0])"),
        pytest.param(lambda x: np.sin(x[..., 0]), id="sin(x[..., 0])"),
        pytest.param(lambda x: math.sin(x[0]), id="math.sin(x[0])"),
        pytest.param(lambda x: math.sin(x.item()), id="math.sin(x.item())"),
        pytest.param(lambda x: [np.sin(x[0])], id="[sin(x[0])]"),
        pytest.param(lambda x: [math.sin(x[0])], id="[math.sin(x[0])]"),
        pytest.param(lambda x: np.array([np.sin(x[0])]), id="array"),
        pytest.param(lambda x: np.array([np.sin(x[0])]) + np.array([0.0]), id="array and offset"),
    ],
)
def test_one_state(f):
    system = qpmhe.System(f, lambda x: x, n=1, p=1)
    check_values(system.f, lambda x, u: np.array([math.sin(x[0])]), 1)


INPUT_A = np.array([[1.0, 0.1], [-0.2, 0.9]])
INPUT_B = np.array([[0.5, 0.3], [-0.4, 1.0]])


def with_input(x, u):
    return INPUT_A @ x + INPUT_B @ u + x * u


@pytest.mark.parametrize(
    ("f", "mode"),
    [
        pytest.param(lambda x, u: x @ INPUT_A.T + u @ INPUT_B.T + x * u, "batched", id="batched"),
        pytest.param(lambda x, u: INPUT_A @ x + INPUT_B @ u + x * u, "columns", id="columns"),
        pytest.param(
            lambda x, u: [
                x[0] + 0.1 * x[1] + 0.5 * u[0] + 0.3 * u[1] + x[0] * u[0],
                -0.2 * x[0] + 0.9 * x[1] - 0.4 * u[0] + u[1] + x[1] * u[1],
            ],
            "columns",
            id="list",
        ),
        pytest.param(
            lambda x, u: np.inner(INPUT_A, x) + np.inner(INPUT_B, u) + x * u, "looped", id="looped"
        ),
        pytest.param(
            lambda x, u=None: x @ INPUT_A.T + u @ INPUT_B.T + x * u, "batched", id="u=None"
        ),
        pytest.param(
            lambda *a: a[0] @ INPUT_A.T + a[1] @ INPUT_B.T + a[0] * a[1], "batched", id="*args"
        ),
    ],
)
def test_inputs(f, mode):
    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1, m=2)
    assert system.f.mode == mode
    check_values(system.f, with_input, 2, 2)
    check_values(system.h, lambda x, u: x[:1], 2, 2)


@pytest.mark.parametrize("m", [1, 2, 3])
@pytest.mark.parametrize(
    ("f", "plain"),
    [
        pytest.param(lambda x, u: x + u[0], lambda x, u: x + u[0], id="x + u[0]"),
        pytest.param(
            lambda x, u: x + u[..., :1], lambda x, u: x + u[0], id="x + u[..., :1]"
        ),
        pytest.param(
            lambda x, u: [x[1], u[0]], lambda x, u: np.array([x[1], u[0]]), id="[x[1], u[0]]"
        ),
        pytest.param(lambda x, u: u[0] * np.ones(2), lambda x, u: u[[0, 0]], id="u alone"),
        pytest.param(
            lambda x, u: [math.sin(x[0]), u[0]],
            lambda x, u: np.array([math.sin(x[0]), u[0]]),
            id="math",
        ),
        pytest.param(lambda x: 2.0 * x, lambda x, u: 2.0 * x, id="no u"),
        pytest.param(
            lambda x, u, scale=3.0: scale * x + u[0], lambda x, u: 3.0 * x + u[0], id="scale=3.0"
        ),
        pytest.param(lambda x, q=0.0: x + q[0], lambda x, u: x + u[0], id="q=0.0"),
    ],
)
def test_few_and_many_inputs(f, plain, m):
    system = qpmhe.System(f, lambda x, u: x[..., :1], n=2, p=1, m=m)
    check_values(system.f, plain, 2, m)


def test_more_inputs_than_states_through_a_multiple_of_the_identity():
    system = qpmhe.System(
        lambda x, u: x + (0.5 * np.eye(3) @ u)[..., :2], lambda x: x[..., :1], n=2, p=1, m=3
    )
    check_values(system.f, lambda x, u: x + 0.5 * u[:2], 2, 3)


def test_outputs_that_depend_on_the_input():
    system = qpmhe.System(
        lambda x: 0.5 * x, lambda x, u: x[0] * u[0] + u[1], n=2, p=1, m=2
    )
    check_values(system.f, lambda x, u: 0.5 * x, 2, 2)
    check_values(system.h, lambda x, u: np.array([x[0] * u[0] + u[1]]), 2, 2)


FAR_STATE = np.array([12.0, 13.0])


@pytest.mark.parametrize(
    ("h", "plain"),
    [
        pytest.param(lambda x: np.sqrt(x - 10.0), lambda x: np.sqrt(x - 10.0), id="batched"),
        pytest.param(
            lambda x: [np.sqrt(x[0] - 10.0), x[1]],
            lambda x: [np.sqrt(x[0] - 10.0), x[1]],
            id="columns",
        ),
        pytest.param(
            lambda x: [math.sqrt(x[0] - 10.0), x[1]],
            lambda x: [math.sqrt(x[0] - 10.0), x[1]],
            id="looped",
        ),
        pytest.param(
            lambda x: np.sqrt(x - 10.0) * np.max(x),
            lambda x: np.sqrt(x - 10.0) * np.max(x),
            id="mixing",
        ),
    ],
)
def test_a_function_defined_far_away_is_tried_at_the_initial_state(h, plain):
    system = qpmhe.System(lambda x: x, h, n=2, p=2)
    assert system.h.mode == "unknown"
    system.check(FAR_STATE, NONE)
    x = np.random.default_rng(2).uniform(11.0, 15.0, (4, 2))
    np.testing.assert_allclose(
        system.h.batch(x, np.zeros((4, 0))), [plain(row) for row in x], rtol=1e-12
    )


def test_a_scalar_output_defined_far_away():
    system = qpmhe.System(lambda x: x, lambda x: math.sqrt(x[0] - 10.0), n=2, p=1)
    system.check(FAR_STATE, NONE)
    np.testing.assert_allclose(system.h(FAR_STATE, NONE), [math.sqrt(2.0)], rtol=1e-15)


def test_a_function_of_the_input_defined_far_away():
    system = qpmhe.System(
        lambda x, u: np.sqrt(x - 10.0) + u[0], lambda x: x[..., :1], n=2, p=1, m=1
    )
    system.check(FAR_STATE, np.zeros(1))
    generator = np.random.default_rng(3)
    x, u = generator.uniform(11.0, 15.0, (4, 2)), generator.standard_normal((4, 1))
    np.testing.assert_allclose(system.f.batch(x, u), np.sqrt(x - 10.0) + u, rtol=1e-12)


def test_functions_are_tried_within_the_state_bounds():
    seen = []

    def f(x):
        seen.append(np.array(x))
        return 0.5 * x

    box = qpmhe.Box([-3.0, 5.0, -np.inf], [-2.0, np.inf, -7.0])
    qpmhe.System(f, lambda x: x[..., :1], n=3, p=1, states=box)
    # Symbols, which prove what it does with many states, have no values.
    single = np.array([x for x in seen if x.ndim == 1 and x.dtype != object], dtype=float)
    assert len(single) >= 3
    assert box.violation(single) == 0.0


def test_sets_and_sizes_are_kept():
    boxes = [qpmhe.Box(-np.ones(d), np.ones(d)) for d in (2, 2, 3)]
    system = qpmhe.System(
        lambda x, u: x, lambda x: np.ones(3), n=2, p=3, m=4,
        states=boxes[0], disturbances=boxes[1], noises=boxes[2],
    )
    assert (system.n, system.p, system.m) == (2, 3, 4)
    assert [system.states, system.disturbances, system.noises] == boxes
    assert "n=2, p=3, m=4" in repr(system)


# Functions that decide by some states of a batch for all of it


def slow_far_out(x):
    return 0.5 * x if x[0] > 50.0 else x + 20.0


FAR = np.array([[60.0], [10.0], [70.0]])


@pytest.mark.parametrize(
    "far_out",
    [
        pytest.param(lambda x: x[0] > 50.0, id="x[0]"),
        pytest.param(lambda x: np.max(x) > 50.0, id="max"),
        pytest.param(lambda x: (x > 50.0).any(), id="any"),
        pytest.param(lambda x: np.all(x > 50.0), id="all"),
        pytest.param(lambda x: x.sum() > 50.0, id="sum"),
        pytest.param(lambda x: np.linalg.norm(x) > 50.0, id="norm"),
        pytest.param(lambda x: float(x.max()) > 50.0, id="float"),
    ],
)
def test_a_branch_beyond_the_probes_is_no_branch_of_a_batch(far_out):
    system = qpmhe.System(
        lambda x: 0.5 * x if far_out(x) else x + 20.0, lambda x: x, n=1, p=1
    )
    found = system.f.batch(FAR, np.zeros((3, 0)))
    np.testing.assert_array_equal(found, [[30.0], [30.0], [35.0]])


@pytest.mark.parametrize("where", ["f", "h"])
def test_an_estimator_that_crosses_a_branch_is_judged_by_the_true_cost(where):
    def bent(x):
        return x if x[0] < 50.0 else 2.0 * x - 50.0

    f, h = (slow_far_out, lambda x: x) if where == "f" else (lambda x: 0.9 * x + 10.0, bent)
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(f, h, n=1, p=1), qpmhe.Luenberger([0.4]),
        qpmhe.QuadraticCost(prior=1.0, disturbance=2.0, noise=3.0),
        horizon=8, initial_state=[30.0], max_qps=2,
    )
    kept = Record(h, [[0.4]], [30.0], [np.diag([1.0]), np.diag([2.0]), np.diag([3.0])], 8)
    sides = set()
    for y in (30.0, 52.0, 70.0, 40.0, 55.0, 66.0, 45.0, 60.0):
        estimate = mhe.update([y])
        kept.push(f, [y])
        assert estimate.candidate_cost == pytest.approx(kept.cost(kept.candidate), rel=1e-10)
        assert estimate.cost == pytest.approx(kept.cost(estimate.trajectory), rel=1e-10)
        sides |= set(estimate.trajectory[:, 0] > 50.0)
    assert sides == {True, False}


def test_a_model_that_wants_arrays_that_it_could_write_to_has_them():
    def wanting(x):
        if not x.flags.writeable:
            raise ValueError("buffer source array is read-only")
        return 0.9 * x

    system = qpmhe.System(wanting, lambda x: x, n=1, p=1)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.5]),
        qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0), horizon=3,
        initial_state=[0.0],
    )
    assert not system.f.reads_only
    assert [mhe.update([y]).improved for y in (1.0, 2.0, 1.5)] == [True] * 3


def test_arrays_of_objects_are_taken_as_numbers():
    def listed(x):
        return np.array([0.9 * x[0] + 0.1 * x[1], 0.8 * x[1]], dtype=object)

    def plain(x):
        return np.array([0.9 * x[0] + 0.1 * x[1], 0.8 * x[1]])

    runs = [
        qpmhe.MovingHorizonEstimator(
            qpmhe.System(f, lambda x: x[:1], n=2, p=1), qpmhe.Luenberger([0.3, 0.1]),
            qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=1.0), horizon=3,
            initial_state=[0.0, 0.0],
        ).run([[1.0], [2.0], [1.5], [1.0]])
        for f in (listed, plain)
    ]
    np.testing.assert_allclose(runs[0].states, runs[1].states, rtol=1e-12)
