"""The theorem's constants against a plain computation, and the proof's chain on scalars."""

import math

import numpy as np
import pytest

from qpmhe.certificates.theorem import DecayingSums, TheoremConstants
from qpmhe.costs import CostConstants
from qpmhe.errors import OptionError, ShapeError

DETECTABILITY = DecayingSums(0.9, 2.0, 3.0, 4.0)
OBSERVER = DecayingSums(0.8, 1.5, 1.7, 0.3)
COST = CostConstants(2.0, (1.0, 2.0), (50.0, 100.0), (20.0, 25.0))


def made(detectability=DETECTABILITY, observer=OBSERVER, cost=COST, **options):
    return TheoremConstants(
        detectability, observer, cost, **{"kappa": 0.2, "lipschitz": 1.4, "horizon": 10} | options
    )


def naive(detectability, observer, cost, kappa, lipschitz, horizon):
    """C_1, C_2, C_3 with sums written out, from the proof and not from its closed forms."""
    eta, rho, a, N = detectability.rate, observer.rate, cost.exponent, horizon
    L_bar = max(lipschitz, 1 / observer.noise)
    c_bar = 3**a * L_bar**a * (cost.disturbance[1] * kappa**a + cost.noise[1])
    t = N + 7
    rho_bar_1 = sum(rho ** (a * i) for i in range(t - N, t)) / rho ** (a * t)
    rho_bar_2 = sum(rho ** (a * (j - N)) for j in range(1, N + 1))
    roots = [(3 * c_bar * r) ** (1 / a) for r in (rho_bar_1, rho_bar_2, rho_bar_2)]
    shifts = (1.0, 1 / rho, 1 / rho)
    C_bar = [C * s * r for C, s, r in zip(observer.constants, shifts, roots, strict=True)]
    series = sum(eta**k for k in range(1, 20000))
    hats = [
        detectability.initial * eta**k / cost.prior[0] ** (1 / a)
        + detectability.disturbance * series / cost.disturbance[0] ** (1 / a)
        + detectability.noise * series / cost.noise[0] ** (1 / a)
        for k in (0, N)
    ]
    began = detectability.initial * (eta / max(eta, rho)) ** N
    own = detectability.constants
    late = [
        hats[1] * bar + began * C + direct
        for bar, C, direct in zip(C_bar, observer.constants, (0.0, *own[1:]), strict=True)
    ]
    early = [hats[0] * bar + direct for bar, direct in zip(C_bar, own, strict=True)]
    return c_bar, (rho_bar_1, rho_bar_2), C_bar, late, early


@pytest.mark.parametrize("seed", range(8))
def test_constants_against_a_plain_computation(seed):
    rng = np.random.default_rng(seed)
    low, wider = rng.uniform(0.1, 5.0, 3), rng.uniform(1.0, 10.0, 3)
    arguments = {
        "detectability": DecayingSums(rng.uniform(0.3, 0.99), *rng.uniform(1.0, 4.0, 3)),
        "observer": DecayingSums(rng.uniform(0.3, 0.99), *rng.uniform(1.0, 2.0, 3)),
        "cost": CostConstants(
            rng.choice([0.5, 1.5, 2.0, 3.0]), *zip(low, low * wider, strict=True)
        ),
        "kappa": rng.uniform(0.0, 2.0), "lipschitz": rng.uniform(0.0, 3.0),
        "horizon": int(rng.integers(1, 25)),
    }
    constants = made(**arguments)
    c_bar, rho_bars, C_bar, late, early = naive(**arguments)
    for found, expected in (
        ((constants.c_bar, constants.rho_bar_1, constants.rho_bar_2), (c_bar, *rho_bars)),
        (constants.C_bar, C_bar), (constants.C_prime, late), (constants.C_double_prime, early),
        (constants.C, np.maximum(late, early)), (constants.result.constants, constants.C),
    ):
        assert found == pytest.approx(expected, rel=1e-10)
    assert constants.lam == max(arguments["detectability"].rate, arguments["observer"].rate)


def test_special_cases():
    # A projected observer: (rho + L_f + 1 / C_w) / L_bar in place of kappa.
    bent = made(lipschitz=0.0, model_lipschitz=1.1)
    assert bent.kappa_bar == pytest.approx((0.8 + 1.1 + 1.0 / 1.7) / (1.0 / 0.3))
    assert pytest.approx(bent.C) == made(lipschitz=0.0, kappa=bent.kappa_bar).C
    # A horizon beyond the numbers.
    far = made(observer=DecayingSums(0.1, 1.0, 1.0, 1.0), horizon=2000).result
    assert np.isinf(far.bound(0.0, [0.0, 1.0], [0.0, 0.0])).all()
    assert far.limit(1.0, 1.0) == math.inf
    assert OBSERVER.limit(0.2, 0.5) == pytest.approx(4.0 * (1.7 * 0.2 + 0.3 * 0.5))
    found = OBSERVER.bound(0.7, [0.2, 0.0], [0.5, 0.0])[2]
    assert found == pytest.approx(0.8**2 * (1.5 * 0.7 + 1.7 * 0.2 + 0.3 * 0.5))
    for make, error, words in (
        (lambda: made(cost=CostConstants(2.0, (1, 1), (2, 1), (1, 1))), OptionError, "disturbance"),
        (lambda: made(observer=DecayingSums(0.5, 1.0, 1.0, 0.0)), OptionError, "C_v"),
        (lambda: DecayingSums(1.0, 1.0, 1.0, 1.0), OptionError, "rate"),
        (lambda: OBSERVER.bound(1.0, [1.0], [-1.0]), OptionError, "negative"),
        (lambda: OBSERVER.bound(1.0, [1.0, 1.0], [1.0]), ShapeError, "shape"),
    ):
        with pytest.raises(error, match=words):
            make()


@pytest.mark.parametrize("seed", range(8))
def test_the_chain_of_the_proof_holds_link_by_link(seed):
    """The observer, and any estimate that costs no more than its trajectory."""
    rng = np.random.default_rng(seed)
    # A scalar system with observer and cost, whose constants are known exactly.
    slope, output = rng.uniform(-1.2, 1.2), rng.uniform(0.5, 2.0) * rng.choice([-1, 1])
    rho, eta = rng.uniform(0.4, 0.9, 2)
    gain, injected = (slope - rng.choice([-1, 1], 2) * (rho, eta)) / output
    weights, N, steps, slack = rng.uniform(0.2, 5.0, 3), int(rng.integers(1, 7)), 25, 1 + 1e-9
    constants = TheoremConstants(
        DecayingSums(eta, 1.0, 1.0 / eta, abs(injected) / eta),
        DecayingSums(rho, 1.0, 1.0 / rho, abs(gain) / rho),
        CostConstants(2.0, *((weight, weight) for weight in weights)),
        kappa=abs(gain), lipschitz=abs(output), horizon=N,
    )
    w, v = rng.standard_normal((2, steps)) * rng.choice([0.0, 0.1, 1.0], (2, steps))
    x, z, y = np.empty(steps + 1), np.empty(steps + 1), np.empty(steps)
    x[0], z[0] = rng.standard_normal(2)
    for t in range(steps):
        y[t] = output * x[t] + v[t]
        x[t + 1] = slope * x[t] + w[t]
        z[t + 1] = slope * z[t] + gain * (y[t] - output * z[t])
    signals = abs(x[0] - z[0]), np.abs(w), np.abs(v)
    assert (np.abs(x - z) <= slack * constants.observer.bound(*signals)).all()
    final = constants.result.bound(*signals)
    for t in range(steps + 1):
        first = t - min(t, N)

        def cost(states, first=first, t=t):
            disturbed, misfit = states[1:] - slope * states[:-1], y[first:t] - output * states[:-1]
            return weights @ [
                (states[0] - z[first]) ** 2, disturbed @ disturbed, misfit @ misfit
            ]

        candidate = z[first : t + 1]
        for _ in range(5):
            move = rng.standard_normal(candidate.size) * 10.0 ** rng.uniform(-2, 2)
            while cost(candidate + move) > cost(candidate) and np.abs(move).max() > 1e-9:
                move *= 0.7
            if cost(candidate + move) <= cost(candidate):
                assert abs(candidate[-1] + move[-1] - x[t]) <= slack * final[t]
