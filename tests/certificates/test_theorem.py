"""The theorem's constants against a plain computation, and the proof's chain on scalars."""

import math

import numpy as np
import pytest

from qpmhe.certificates.theorem import DecayingSums, Sizes, TheoremConstants, decaying_sums
from qpmhe.costs import CostConstants
from qpmhe.errors import OptionError, ShapeError

DETECTABILITY = DecayingSums(0.9, 2.0, 3.0, 4.0)
OBSERVER = DecayingSums(0.8, 1.5, 1.7, 0.3)
COST = CostConstants(2.0, (1.0, 2.0), (50.0, 100.0), (20.0, 25.0))


def made(detectability=DETECTABILITY, observer=OBSERVER, cost=COST, kappa=0.2, lipschitz=1.4,
         horizon=10):
    return TheoremConstants(
        detectability, observer, cost, kappa=kappa, lipschitz=lipschitz, horizon=horizon
    )


def drawn(seed):
    rng = np.random.default_rng(seed)

    def pair():
        low = rng.uniform(0.1, 5.0)
        return low, low * rng.uniform(1.0, 10.0)

    return {
        "detectability": DecayingSums(rng.uniform(0.3, 0.99), *rng.uniform(1.0, 4.0, 3)),
        "observer": DecayingSums(rng.uniform(0.3, 0.99), *rng.uniform(1.0, 2.0, 3)),
        "cost": CostConstants(
            float(rng.choice([0.5, 1.0, 1.5, 2.0, 3.0])), pair(), pair(), pair()
        ),
        "kappa": rng.uniform(0.0, 2.0),
        "lipschitz": rng.uniform(0.0, 3.0),
        "horizon": int(rng.integers(1, 25)),
    }


def naive(detectability, observer, cost, kappa, lipschitz, horizon):
    """C_1, C_2, C_3 with sums written out, from the proof and not from its closed forms."""
    eta, rho, a, N = detectability.rate, observer.rate, cost.exponent, horizon
    L_bar = lipschitz
    if 1 / observer.noise > L_bar:
        L_bar = 1 / observer.noise
    c_bar = 3**a * L_bar**a * cost.disturbance[1] * kappa**a + 3**a * L_bar**a * cost.noise[1]
    t = N + 7
    rho_bar_1 = sum(rho ** (a * i) for i in range(t - N, t)) / rho ** (a * t)
    rho_bar_2 = sum(rho ** (a * (j - N)) for j in range(1, N + 1))
    roots = [(3 * c_bar * r) ** (1 / a) for r in (rho_bar_1, rho_bar_2, rho_bar_2)]
    shifts = (1.0, 1 / rho, 1 / rho)
    C_bar = [C * s * r for C, s, r in zip(observer.constants, shifts, roots, strict=True)]
    series = sum(eta**k for k in range(1, 20000))
    lam = eta if eta > rho else rho
    hats = {
        k: detectability.initial * eta**k / cost.prior[0] ** (1 / a)
        + detectability.disturbance * series / cost.disturbance[0] ** (1 / a)
        + detectability.noise * series / cost.noise[0] ** (1 / a)
        for k in (0, N)
    }
    own = (0.0, detectability.disturbance, detectability.noise)
    late = [
        hats[N] * bar + detectability.initial * (eta / lam) ** N * C + direct
        for bar, C, direct in zip(C_bar, observer.constants, own, strict=True)
    ]
    own = detectability.constants
    early = [hats[0] * bar + direct for bar, direct in zip(C_bar, own, strict=True)]
    return c_bar, (rho_bar_1, rho_bar_2), C_bar, late, early


@pytest.mark.parametrize("seed", range(25))
def test_constants_against_a_plain_computation(seed):
    arguments = drawn(seed)
    constants = made(**arguments)
    c_bar, rho_bars, C_bar, late, early = naive(**arguments)
    assert constants.c_bar == pytest.approx(c_bar, rel=1e-12)
    assert (constants.rho_bar_1, constants.rho_bar_2) == pytest.approx(rho_bars, rel=1e-10)
    assert constants.C_bar == pytest.approx(C_bar, rel=1e-10)
    assert constants.C_prime == pytest.approx(late, rel=1e-10)
    assert constants.C_double_prime == pytest.approx(early, rel=1e-10)
    assert pytest.approx(np.maximum(late, early), rel=1e-10) == constants.C
    assert constants.result.constants == constants.C
    assert constants.lam == max(arguments["detectability"].rate, arguments["observer"].rate)


def test_one_step_horizon():
    constants = made(horizon=1)
    assert constants.rho_bar_2 == pytest.approx(1.0, rel=1e-14)
    assert constants.rho_bar_1 == pytest.approx(0.8**-2, rel=1e-14)
    # 1 / C_v exceeds L_h here.
    assert constants.L_bar == 1 / 0.3
    assert constants.c_bar == pytest.approx(100.0 * (100.0 * 0.04 + 25.0))


def test_rates_near_one_keep_their_digits():
    slow = made(observer=DecayingSums(1.0 - 1e-12, 1.0, 1.0, 1.0), horizon=7)
    assert slow.rho_bar_2 == pytest.approx(7.0, rel=1e-9)
    assert slow.rho_bar_1 == pytest.approx(7.0, rel=1e-9)


def test_constants_grow_with_the_horizon_like_powers_of_the_observers_rate():
    values = np.array([made(horizon=N).C_double_prime for N in range(1, 80)])
    assert (np.diff(values, axis=0) > 0).all()
    np.testing.assert_allclose(values[-1] / values[-2], 1 / 0.8, rtol=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_worse_assumptions_never_give_better_constants(seed):
    arguments = drawn(seed)
    before = np.array(made(**arguments).C)

    def worse(name, **changes):
        given = arguments[name]
        fields = {f: getattr(given, f) for f in given.__dataclass_fields__} | changes
        return arguments | {name: type(given)(**fields)}

    d, o, c = (arguments[name] for name in ("detectability", "observer", "cost"))
    changed = [
        worse("detectability", initial=1.1 * d.initial),
        worse("detectability", disturbance=1.1 * d.disturbance),
        worse("detectability", noise=1.1 * d.noise),
        worse("observer", initial=1.1 * o.initial),
        worse("observer", disturbance=1.1 * o.disturbance),
        worse("cost", noise=(c.noise[0], 1.1 * c.noise[1])),
        worse("cost", prior=(0.9 * c.prior[0], c.prior[1])),
        worse("cost", disturbance=(0.9 * c.disturbance[0], c.disturbance[1])),
        arguments | {"kappa": arguments["kappa"] + 0.1},
        arguments | {"lipschitz": 1.1 * arguments["lipschitz"]},
        arguments | {"horizon": arguments["horizon"] + 1},
    ]
    early = np.array(made(**arguments).C_double_prime)
    for each in changed[:-1]:
        assert (np.array(made(**each).C) >= before * (1 - 1e-12)).all()
    assert (np.array(made(**changed[-1]).C_double_prime) >= early).all()


def test_a_common_factor_of_the_weights_changes_nothing():
    scaled = CostConstants(2.0, *(
        (7.0 * low, 7.0 * high) for low, high in (COST.prior, COST.disturbance, COST.noise)
    ))
    assert pytest.approx(made().C, rel=1e-13) == made(cost=scaled).C


def test_an_observer_that_never_corrects_and_a_constant_output():
    constants = made(kappa=0.0, lipschitz=0.0)
    assert constants.c_bar == pytest.approx(9.0 / 0.09 * 25.0)
    assert all(math.isfinite(value) for value in constants.C)


def test_a_horizon_beyond_the_numbers_gives_infinite_constants():
    constants = made(observer=DecayingSums(0.1, 1.0, 1.0, 1.0), horizon=2000)
    assert (math.inf,) * 3 == constants.C
    bound = constants.result.bound(0.0, [0.0, 1.0], [0.0, 0.0])
    assert np.isinf(bound).all()
    assert constants.result.limit(1.0, 1.0) == math.inf


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"horizon": 0}, "horizon"),
        ({"kappa": -1.0}, "kappa"),
        ({"kappa": math.nan}, "kappa"),
        ({"lipschitz": math.inf}, "lipschitz"),
        ({"cost": CostConstants(0.0, (1, 1), (1, 1), (1, 1))}, "exponent"),
        ({"cost": CostConstants(2.0, (0.0, 1), (1, 1), (1, 1))}, "prior"),
        ({"cost": CostConstants(2.0, (1, 1), (2, 1), (1, 1))}, "disturbance"),
        ({"observer": DecayingSums(0.5, 1.0, 1.0, 0.0)}, "C_v"),
    ],
)
def test_bad_constants_are_named(arguments, words):
    with pytest.raises(OptionError, match=words):
        made(**arguments)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((1.0, 1.0, 1.0, 1.0), "rate"),
        ((0.0, 1.0, 1.0, 1.0), "rate"),
        ((0.5, 0.9, 1.0, 1.0), "initial"),
        ((0.5, 1.0, -1.0, 1.0), "disturbance"),
        ((0.5, 1.0, 1.0, math.nan), "noise"),
        ((0.5, "1", 1.0, 1.0), "initial"),
    ],
)
def test_bad_decaying_sums_are_named(arguments, words):
    with pytest.raises(OptionError, match=words):
        DecayingSums(*arguments)


def test_decaying_sums_along_a_record():
    rng = np.random.default_rng(1)
    w, v = rng.random(12), rng.random(12)
    bound = OBSERVER.bound(0.7, w, v)
    for t in range(13):
        expected = 1.5 * 0.7 * 0.8**t + sum(
            0.8**tau * (1.7 * w[t - tau] + 0.3 * v[t - tau]) for tau in range(1, t + 1)
        )
        assert bound[t] == pytest.approx(expected, rel=1e-12)
    constant = OBSERVER.bound(0.0, np.full(400, 0.2), np.full(400, 0.5))
    assert constant[-1] == pytest.approx(OBSERVER.limit(0.2, 0.5), rel=1e-12)
    with pytest.raises(ShapeError):
        OBSERVER.bound(1.0, w, v[:-1])
    with pytest.raises(OptionError, match="negative"):
        OBSERVER.bound(1.0, w, -v)


def scalar(rng):
    """A scalar system with observer and cost, whose constants are known exactly."""
    slope, output = rng.uniform(-1.2, 1.2), rng.uniform(0.5, 2.0) * rng.choice([-1, 1])
    rho, eta = rng.uniform(0.4, 0.9, 2)
    gain, injected = (slope - rng.choice([-1, 1], 2) * (rho, eta)) / output
    weights = rng.uniform(0.2, 5.0, 3)
    constants = TheoremConstants(
        DecayingSums(eta, 1.0, 1.0 / eta, abs(injected) / eta),
        DecayingSums(rho, 1.0, 1.0 / rho, abs(gain) / rho),
        CostConstants(2.0, *((weight, weight) for weight in weights)),
        kappa=abs(gain), lipschitz=abs(output), horizon=int(rng.integers(1, 7)),
    )
    return slope, output, gain, weights, constants


def admissible(rng, problem, ys, zs):
    """Any trajectory through the window that costs no more than the candidate."""
    slope, output, _, weights, _ = problem

    def cost(xs):
        w, v = xs[1:] - slope * xs[:-1], ys - output * xs[:-1]
        parts = weights[0] * (xs[0] - zs[0]) ** 2, weights[1] * w**2, weights[2] * v**2
        return parts[0] + parts[1].sum() + parts[2].sum(), w, v

    allowed = cost(zs)[0]
    move = rng.standard_normal(zs.size) * 10.0 ** rng.uniform(-2, 2)
    while cost(zs + move)[0] > allowed:
        move *= 0.7
        if np.abs(move).max() < 1e-9:
            move[:] = 0.0
    return zs + move, allowed, *cost(zs + move)


def lemma_bound(constants, start, w, v):
    """The lemma's bound of the estimate's cost, (eq:lem_1), at t = 0, ..., T."""
    C_p, C_w, C_v = constants.observer.constants
    a, rho = constants.cost.exponent, constants.observer.rate
    first = constants.rho_bar_1 * (C_p * start * rho ** np.arange(w.size + 1.0)) ** a
    second = (C_w * decaying_sums(rho, w)) ** a + (C_v * decaying_sums(rho, v)) ** a
    return constants.c_bar * (first + constants.rho_bar_2 * second)


@pytest.mark.parametrize("seed", range(20))
def test_the_chain_of_the_proof_holds_link_by_link(seed):
    rng = np.random.default_rng(seed)
    problem = scalar(rng)
    slope, output, gain, weights, constants = problem
    rho, lam, N, steps = constants.observer.rate, constants.lam, constants.horizon, 25
    w, v = rng.standard_normal((2, steps)) * rng.choice([0.0, 0.1, 1.0], (2, steps))
    x, z = np.empty(steps + 1), np.empty(steps + 1)
    x[0], z[0] = rng.standard_normal(2)
    y = np.empty(steps)
    for t in range(steps):
        y[t] = output * x[t] + v[t]
        x[t + 1] = slope * x[t] + w[t]
        z[t + 1] = slope * z[t] + gain * (y[t] - output * z[t])
    start, lengths = abs(x[0] - z[0]), (np.abs(w), np.abs(v))
    slack = 1 + 1e-9
    assert (np.abs(x - z) <= slack * constants.observer.bound(start, *lengths)).all()
    lemma = lemma_bound(constants, start, *lengths)
    final = constants.result.bound(start, *lengths)
    # The bracket of (eq:bound_hat_x), and the misfit's bound (eq:proof_2).
    bracket = DecayingSums(rho, *(max(1.0, C) for C in constants.C_bar))
    assert min(constants.C_bar) > 0
    for t in range(steps + 1):
        sums = [
            sum(rho**tau * length[t - tau] for tau in range(1, t + 1)) for length in lengths
        ]
        inside = sum(
            C * value
            for C, value in zip(constants.C_bar, (start * rho**t, *sums), strict=True)
        )
        assert inside <= slack * bracket.bound(start, *lengths)[t]
        if t < steps:
            now = sums[0] + lengths[0][t], sums[1] + lengths[1][t]
            _, C_w, C_v = constants.observer.constants
            misfit = constants.L_bar * (start * rho**t + C_w * now[0] + C_v * now[1])
            assert abs(y[t] - output * z[t]) <= slack * misfit
        k = min(t, N)
        window = slice(t - k, t)
        for _ in range(5):
            hat, allowed, reached, w_hat, v_hat = admissible(
                rng, problem, y[window], z[t - k : t + 1]
            )
            assert reached <= allowed <= slack * lemma[t] + 1e-12
            assert abs(hat[0] - z[t - k]) <= slack * inside / weights[0] ** 0.5 + 1e-9
            for parts, weight in ((w_hat, weights[1]), (v_hat, weights[2])):
                assert (np.abs(parts) <= slack * inside / weight**0.5 + 1e-9).all()
            assert abs(hat[-1] - x[t]) <= slack * final[t]
    assert lam < 1


@pytest.mark.parametrize("values", [(0.0, 0.0), (-1.0, 1.0), (1.0, math.inf)])
def test_bad_sizes_are_named(values):
    with pytest.raises(OptionError, match=r"disturbance|noise"):
        Sizes(*values)
