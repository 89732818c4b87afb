"""Learn a camera's noise as a function of the brightness, through the estimator, with JAX.

A small network gives the variance of each measurement from the brightness of its picture. It is
trained so that the estimates come near the true states of a few records, as a motion capture system
gives them. The derivatives of the estimates by the variances are those of `mhe.sensitivity()`;
`estimates` tells JAX of them. A table compares the errors on records that were not used.
"""

import argparse
from time import perf_counter

import camera
import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)


@jax.custom_vjp
def estimates(measurements, variances):
    """The estimates (T, 2), for variances (T,) of the noise."""
    shape = jax.ShapeDtypeStruct((len(variances), 2), jnp.float64)
    return jax.pure_callback(
        lambda y, v: camera.estimate(np.asarray(y), np.asarray(v)), shape, measurements, variances
    )


def _forward(measurements, variances):
    shapes = tuple(
        jax.ShapeDtypeStruct((len(variances), *size), jnp.float64)
        for size in ((2,), (2, camera.HORIZON))
    )
    states, slopes = jax.pure_callback(
        lambda y, v: camera.estimate_and_slopes(np.asarray(y), np.asarray(v)), shapes,
        measurements, variances,
    )
    return states, (measurements, slopes)


def _backward(saved, cotangents):
    measurements, slopes = saved
    along = jnp.einsum("tn,tnk->tk", cotangents, slopes)
    samples = jnp.arange(len(along))[:, None] + jnp.arange(1 - camera.HORIZON, 1)
    by_variance = jnp.zeros(len(along)).at[jnp.maximum(samples, 0)].add(along)
    return jnp.zeros_like(measurements), by_variance


estimates.defvjp(_forward, _backward)


def network(parameters, brightness):
    """The variance for each brightness: one hidden layer, positive by its exponential."""
    inner, shift, outer, offset = parameters
    hidden = jnp.tanh(jnp.outer(brightness, inner) + shift)
    return jnp.exp(hidden @ outer + offset)


def constant(parameters, brightness):
    """One variance for all pictures."""
    return jnp.full(len(brightness), jnp.exp(parameters[0]))


def loss(model, parameters, records):
    """The mean square error of the estimates, in standard deviations of the disturbance."""
    return sum(
        jnp.mean(
            ((estimates(Y, model(parameters, light)) - X[1:]) / camera.DISTURBANCE) ** 2
        )
        for X, Y, light in records
    ) / len(records)


def trained(model, parameters, records, steps, rate=0.1):
    """The parameters after some steps of Adam."""
    slope = jax.value_and_grad(lambda given: loss(model, given, records))
    first = second = jax.tree.map(jnp.zeros_like, parameters)
    for k in range(1, steps + 1):
        value, gradient = slope(parameters)
        if k == 1 or k % 20 == 0:
            print(f"  step {k:3d}: loss {float(value):.3f}")
        first = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, first, gradient)
        second = jax.tree.map(lambda m, g: 0.99 * m + 0.01 * g * g, second, gradient)
        parameters = jax.tree.map(
            lambda p, m, s, k=k: p - rate * (m / (1 - 0.9**k))
            / (jnp.sqrt(s / (1 - 0.99**k)) + 1e-12),
            parameters, first, second,
        )
    return parameters


def ratio():
    """How long a derivative takes beside a step."""
    _, Y, _ = camera.record(0)
    mhe, times = camera.estimator(), []
    for y in Y:
        marks = [perf_counter()]
        mhe.update(y)
        marks.append(perf_counter())
        sensitivity = mhe.sensitivity()
        marks.append(perf_counter())
        _ = sensitivity.adjoint(np.ones(2)).noise_weights
        marks.append(perf_counter())
        times.append(np.diff(marks))
    middle = np.median(times, axis=0)
    return middle[1:] / middle[0]


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--steps", type=int, default=60, help="steps of Adam")
    parser.add_argument("--records", type=int, default=3, help="records to learn from")
    parser.add_argument("--tests", type=int, default=20, help="records to judge by")
    options = parser.parse_args()
    records = [camera.record(seed) for seed in range(options.records)]
    rng = np.random.default_rng(0)
    start = jnp.log(0.1**2)
    models = {
        "one learnt constant": (constant, (start,)),
        "learnt from the brightness": (
            network,
            (jnp.array(rng.normal(size=8) * 4.0), jnp.array(rng.normal(size=8)), jnp.zeros(8),
             start),
        ),
    }
    rows, tests = [], [camera.record(1000 + seed) for seed in range(options.tests)]

    def errors(variance):
        return [camera.estimate(Y, variance(light)) - X[1:] for X, Y, light in tests]

    for name, (model, parameters) in models.items():
        print(name)
        learnt = trained(model, parameters, records, options.steps)
        rows.append((name, errors(lambda s, m=model, p=learnt: np.asarray(m(p, s)))))
    rows.append(("true", errors(lambda s: camera.deviation(s) ** 2)))
    print(f"\nErrors on {options.tests} other records, RMS:\n")
    print(camera.table(rows))
    shown = np.array([0.05, 0.25, 0.45, 0.65, 0.85])
    print("\nbrightness         ", *(f"{one:8.2f}" for one in shown))
    print("learnt deviation, rad", *(f"{one:8.3f}" for one in np.sqrt(network(learnt, shown))))
    print("true deviation, rad  ", *(f"{one:8.3f}" for one in camera.deviation(shown)))
    factor, solve = ratio()
    print(f"\nIn steps of the estimator, factorisation takes {factor:.1f}, an adjoint {solve:.2f}.")


if __name__ == "__main__":
    main()
