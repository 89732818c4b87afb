"""Systems for `planted_faults.py` beside those of the zoo; HELD_BACK were not used to develop."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import qpmhe
from qpmhe.models.example import make_example


def _levels(*levels: float, length: int) -> Callable[[int, Any], list[float]]:
    """An input that goes through these levels, each for so many samples."""
    return lambda t, _: [levels[t // length % len(levels)]]


def _example(
    rate: Callable[..., Any], h: Callable[..., Any], *, dt: float, start: list[float],
    guess: list[float], prior: list[float], disturbance: list[float], noise: list[float],
    inputs: Callable[[int, Any], list[float]] | None = None, m: int = 0,
    labels: tuple[str, ...] = (),
) -> Any:
    system = qpmhe.System.from_ode(rate, h, dt=dt, n=len(start), p=len(noise), m=m)
    covariances = {
        name: np.diag(np.square(values))
        for name, values in (("prior", prior), ("disturbance", disturbance), ("noise", noise))
    }
    return make_example(
        system, qpmhe.ExtendedKalman(**covariances), prior=prior, disturbance=disturbance,
        noise=noise, initial_state=start, initial_estimate=guess, dt=dt, horizon=10, steps=400,
        labels=labels, inputs=inputs,
    )


def heater() -> Any:
    """A heated mass that cools to its surroundings; the second input is the parameter of that."""
    powers = _levels(2.0, 0.5, 3.0, 1.0, length=40)
    return _example(
        lambda x, u: [u[0] - u[1] * x[0]], lambda x, _: [x[0]], dt=0.5, start=[5.0], guess=[4.0],
        prior=[2.0], disturbance=[0.03], noise=[0.1], m=2, labels=("temperature",),
        inputs=lambda t, x: [*powers(t, x), 0.2],
    )


def tanks() -> Any:
    """Two tanks in a row, of which both levels are measured; the second input is a parameter."""
    flows = _levels(1.0, 1.6, 0.7, 1.3, 1.0, length=50)

    def rate(x: Any, u: Any) -> list[Any]:
        between = 0.5 * np.sqrt(np.maximum(x[0], 1e-3))
        return [u[0] - between, between - u[1] * np.sqrt(np.maximum(x[1], 1e-3))]

    return _example(
        rate, lambda x, _: [x[0], x[1]], dt=0.5, start=[4.0, 6.0], guess=[3.0, 5.0],
        prior=[1.0, 1.0], disturbance=[0.02, 0.02], noise=[0.06, 0.06], m=2,
        labels=("level 1", "level 2"), inputs=lambda t, x: [*flows(t, x), 0.4],
    )


def motor() -> Any:
    """A DC motor with a load: current, speed and angle, of which current and angle are measured."""
    volts = _levels(6.0, -3.0, 4.0, 0.0, -5.0, 2.0, length=25)
    return _example(
        lambda x, u: [
            (u[0] - 1.0 * x[0] - 0.5 * x[1]) / 0.2, (0.5 * x[0] - 0.05 * x[1]) / 0.1, x[1]],
        lambda x, _: [x[0], x[2]], dt=0.04, start=[0.0, 0.0, 0.0], guess=[0.0, 1.0, 0.0],
        prior=[1.0, 2.0, 0.5], disturbance=[0.05, 0.05, 0.002], noise=[0.15, 0.04], inputs=volts,
        m=1, labels=("current", "speed", "angle"),
    )


def rod() -> Any:
    """A rod heated at one end: four temperatures, of which the outer ones are measured."""
    powers = _levels(4.0, 0.0, 2.0, 6.0, 1.0, length=45)

    def rate(x: Any, u: Any) -> list[Any]:
        flows = [0.25 * (x[i] - x[i + 1]) for i in range(3)]
        return [0.2 * u[0] - flows[0], flows[0] - flows[1], flows[1] - flows[2],
                flows[2] - 0.1 * x[3]]

    return _example(
        rate, lambda x, _: [x[0], x[3]], dt=1.0, start=[8.0, 7.0, 6.0, 5.0],
        guess=[6.0, 6.0, 6.0, 6.0], prior=[2.0] * 4, disturbance=[0.04] * 4, noise=[0.1, 0.1],
        inputs=powers, m=1, labels=("1", "2", "3", "4"),
    )


def predators() -> Any:
    """Lotka and Volterra's predators and prey, counted both."""
    return _example(
        lambda x: [x[0] * (1.0 - 0.5 * x[1]), x[1] * (0.4 * x[0] - 0.8)],
        lambda x: [x[0], x[1]], dt=0.1, start=[3.0, 1.5], guess=[2.0, 2.0], prior=[1.0, 1.0],
        disturbance=[0.01, 0.01], noise=[0.1, 0.1], labels=("prey", "predators"),
    )


#: By name: what makes them, and how many of their last inputs are parameters.
DEVELOPED = {
    **{
        name: (qpmhe.models.catalogue()[name], 0)
        for name in ("vehicle", "van_der_pol", "cstr", "battery_cell")
    },
    "heater": (heater, 1),
}
HELD_BACK = {"tanks": (tanks, 1), "motor": (motor, 0), "rod": (rod, 0), "predators": (predators, 0)}
SYSTEMS = {
    **{name: (made, 0) for name, made in qpmhe.models.catalogue().items()}, **DEVELOPED,
    **HELD_BACK,
}
