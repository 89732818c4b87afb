"""Ways of writing one function, and the comparison of a batched function with a plain one."""

import math
from functools import partial

import numpy as np

from qpmhe.adapters.casadi import _compiled
from qpmhe.codegen.compiler import compiled_library
from qpmhe.codegen.model_source import model_files
from qpmhe.model.evaluation import Evaluator

LEADS = [(), (1,), (2,), (5,), (1, 2), (2, 1), (2, 3), (4, 5)]
NONE = np.zeros(0)


def evaluated_in_c(model):
    """A function of a name among f, h and their Jacobians, x and u, without the library's check."""
    library = compiled_library(model_files(model), "model.c")
    return Evaluator(partial(_compiled, model, library, False)).one


def check_values(function, plain, n, m=0):
    """The value at one state and over leading dimensions, against plain(x, u) state by state."""
    generator = np.random.default_rng(1)
    for lead in LEADS:
        x = generator.uniform(0.3, 2.0, (*lead, n))
        u = generator.uniform(0.3, 2.0, (*lead, m))
        pairs = zip(x.reshape(-1, n), u.reshape(math.prod(lead), m), strict=True)
        expected = np.array([plain(*pair) for pair in pairs]).reshape(*lead, -1)
        found = np.asarray(function.batch(x, u)) if lead else np.asarray(function(x, u))
        assert found.shape == expected.shape, lead
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14, err_msg=str(lead))


def parts(x, sin=np.sin):
    return [x[0] + 0.1 * x[1], 0.9 * x[1] - 0.2 * sin(x[0])]


def pendulum(x, u):
    return np.array(parts(x, math.sin))


def branching(x):
    return np.array(parts(x, np.sin if x[0] > -100.0 else np.zeros_like))


def into_zeros(x):
    value = np.zeros(2)
    value[0], value[1] = parts(x)
    return value


def ellipsis(x):
    value = np.empty_like(x)
    value[..., 0] = x[..., 0] + 0.1 * x[..., 1]
    value[..., 1] = 0.9 * x[..., 1] - 0.2 * np.sin(x[..., 0])
    return value


# The function, and whether it is traced.
PENDULUMS = {
    "ellipsis": (ellipsis, True),
    "stacked": (lambda x: np.stack(parts(np.moveaxis(x, -1, 0)), axis=-1), True),
    "array of components": (lambda x: np.array(parts(x)), True),
    "list": (lambda x: parts(x), True),
    "tuple": (lambda x: tuple(parts(x)), True),
    "math": (lambda x: np.array(parts(x, math.sin)), True),
    "list of math": (lambda x: parts(x, math.sin), True),
    "branch": (branching, False),
    "into zeros": (into_zeros, True),
}
