"""Small systems that several tests of the estimator share."""

import numpy as np

import qpmhe


def swing(x):
    return np.stack(
        [x[..., 0] + 0.2 * x[..., 1], 0.9 * x[..., 1] - 0.2 * np.sin(x[..., 0])], axis=-1
    )


def linear(A, C, **options):
    A, C = np.array(A, dtype=float), np.array(C, dtype=float)
    return qpmhe.System(lambda x: x @ A.T, lambda x: x @ C.T, n=len(A), p=len(C), **options)
