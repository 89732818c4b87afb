"""A backend as a user would write it: quadprog, called directly."""

import numpy as np

from qpmhe_solvers import QP, Backend, RawSolution, Solver


class Quadprog(Solver):
    def _solve(self, qp: QP, start: np.ndarray | None) -> RawSolution:
        import quadprog

        normals = np.vstack((np.eye(qp.size), qp.dense_rows()))
        lower = np.concatenate((qp.lower, qp.row_lower), axis=None)
        upper = np.concatenate((qp.upper, qp.row_upper), axis=None)
        equal = np.flatnonzero(lower == upper)
        above = np.flatnonzero(np.isfinite(lower) & (lower < upper))
        below = np.flatnonzero(np.isfinite(upper) & (lower < upper))
        matrix = np.vstack((normals[equal], normals[above], -normals[below], np.zeros(qp.size)))
        side = np.concatenate((lower[equal], lower[above], -upper[below], [-1.0]))
        x, _, _, steps, pushes, _ = quadprog.solve_qp(
            qp.dense(), -qp.gradient.ravel(), matrix.T, side, equal.size
        )
        duals = np.zeros(lower.size)
        duals[equal] = -pushes[: equal.size]
        duals[above] -= pushes[equal.size : equal.size + above.size]
        duals[below] += pushes[equal.size + above.size : -1]
        return RawSolution(x, True, int(steps[0]), duals[: qp.size], duals[qp.size :])


def entry(name: str = "mine") -> Backend:
    return Backend(name, Quadprog, "active set", "quadprog", "quadprog")
