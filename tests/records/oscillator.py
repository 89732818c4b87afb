"""Models of these tests, and records of them."""

import numpy as np

import qpmhe

DT = 0.1
A = np.array([[1.0, DT], [-DT, 1.0 - 0.5 * DT]])


def rate(x, u):
    return np.stack((x[..., 1], -x[..., 0] - 0.5 * x[..., 1] + u[..., 0]), axis=-1)


def output(x):
    return x[..., :1] + 0.1 * x[..., :1] ** 3


def continuous():
    """Steps of any length; bounds that bind."""
    states = qpmhe.Box([-0.5, -1.0], [0.7, 1.0])
    system = qpmhe.System.from_ode(rate, output, dt=DT, n=2, p=1, m=1, states=states)
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=np.eye(2), disturbance=1e-4 * np.eye(2), noise=[[0.01]]
    )
    return system, qpmhe.Luenberger([[0.3], [0.1]]), cost, {
        "horizon": 6, "initial_state": [0.5, 0.0], "states": ["position", "speed"], "max_qps": 2,
    }


def discrete():
    """Equal steps, two outputs, no inputs, nothing optional but what is needed."""
    system = qpmhe.System(lambda x: x @ A.T, lambda x: x, n=2, p=2)
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=100 * np.eye(2), noise=np.eye(2))
    options = {"horizon": 5, "initial_state": [0.0, 0.0]}
    return system, qpmhe.Luenberger(0.3 * np.eye(2)), cost, options


def lines(samples, seed=0, irregular=True, gaps=0.03):
    """A CSV record of the continuous model, line by line, with blanks and gaps."""
    generator = np.random.default_rng(seed)
    x, t, text = np.array([0.9, 0.0]), 0.0, ["time,y,u"]
    for k in range(samples):
        dt = DT * (generator.uniform(0.5, 1.4) if irregular else 1.0)
        dt *= 3 if generator.random() < gaps else 1
        u = float(np.sin(0.3 * k))
        y = float(output(x)[0] + 0.1 * generator.standard_normal())
        blank_y, blank_u = generator.random(2) < 0.1
        text.append(f"{t},{'' if blank_y else y},{'' if blank_u and k else u}")
        for _ in range(10):
            x = x + dt / 10 * rate(x, np.array([u]))
        t = round(t + dt, 6)
    return text


def as_json(text):
    """CSV lines as JSON lines, with blanks left out or null."""
    names = text[0].split(",")
    found = []
    for k, line in enumerate(text[1:]):
        pairs = dict(zip(names, line.split(","), strict=True))
        kept = {name: one or None for name, one in pairs.items() if one or k % 2}
        found.append("{" + ", ".join(
            f'"{name}": {"null" if one is None else one}' for name, one in kept.items()) + "}")
    return found
