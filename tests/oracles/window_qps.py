"""Random QPs of a window, for the solver in C alone, and what any solution must satisfy."""

import ctypes
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

import qpmhe
from qpmhe.codegen.compiler import compiled_library
from qpmhe.codegen.layout import SET_NAMES, Layout
from qpmhe.codegen.source import estimator_files

SOLVED, STOPPED, UNCONSTRAINED, FAILED = range(4)

# Solve the QP around a trajectory whose residuals and Jacobians are given.
HOOK = """
int32_t solve(mhe_estimator *e, mhe_workspace *k, const mhe_settings *s, int32_t count,
              const real *prior, const real *x, const real *w, const real *v, const real *A,
              const real *C, real *step, int32_t nearest, const int8_t *places)
{
    mhe_outcome o;
    mhe_trial *trial = k->trials + 1;
    memset(&o, 0, sizeof o);
    memset(k->left_out, 0, sizeof k->left_out);
    memcpy(k->rows.place, places, sizeof k->rows.place);
    memset(e, 0, sizeof *e);
    e->settings = s;
    k->prior.mean = e->stages[0].z;
    k->prior.weight = k->prior.distance_weight = s->prior_weight;
    e->length = count;
    memcpy(e->stages[0].z, prior, sizeof e->stages[0].z);
    mhe_set_prior(e, k);
    memcpy(trial->x, x, sizeof(real) * (size_t)(count + 1) * NX);
    memcpy(trial->w, w, sizeof(real) * (size_t)count * NX);
    memcpy(trial->v, v, sizeof(real) * (size_t)count * NY);
    for (int i = 0; i <= count; i++) k->factors[i] = 1;
    for (int i = 0; i < count; i++) {
        mhe_terms *t = k->terms + i;
        memcpy(t->f_jacobian, A + i * NX * NX, sizeof t->f_jacobian);
        memcpy(t->h_jacobian, C + i * NY * NX, sizeof t->h_jacobian);
        for (int j = 0; j < NY; j++) e->stages[i].is_observed[j] = 1;
        mhe_set_noise_weight(s, e->stages + i);
        mhe_set_terms(s, 0, e->stages + i, w + i * NX, v + i * NY, t);
        k->at[i] = t;
    }
    mhe_set_limits(e, k, trial->x, trial);
    const int status = mhe_solve_qp(e, k, &o, trial, nearest, 0);
    memcpy(step, k->step, sizeof(real) * (size_t)(count + 1) * NX);
    return status + 4 * o.iterations;
}
"""


@dataclass
class WindowQP:
    """min |x0 + d0 - prior|^2_P + sum |w + d+ - A d|^2_Q + |v - C d|^2_R over d, in the sets.

    The sets, by their names in `SET_NAMES`, hold for w, v and x: matrix, lower and upper; of a
    matrix, the first rows are the components.
    """

    P: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    prior: np.ndarray
    x: np.ndarray
    w: np.ndarray
    v: np.ndarray
    A: np.ndarray
    C: np.ndarray
    sets: dict = field(default_factory=dict)

    @property
    def sizes(self):
        """States, outputs and samples."""
        return self.x.shape[1], self.v.shape[1], len(self.w)

    def residual_matrix(self):
        """M such that (x0, all w, all v, all x) change by M d."""
        n, p, count = self.sizes
        size = n * (count + 1)
        w, v = np.zeros((count, n, size)), np.zeros((count, p, size))
        for i in range(count):
            own, following = slice(i * n, (i + 1) * n), slice((i + 1) * n, (i + 2) * n)
            w[i][:, own], w[i][:, following] = -self.A[i], np.eye(n)
            v[i][:, own] = -self.C[i]
        return w, v, np.eye(size).reshape(count + 1, n, size)

    def dense(self):
        """Hessian and gradient; matrix, lower and upper of all rows with limits, and scales."""
        n, _, count = self.sizes
        w, v, x = self.residual_matrix()
        H = x[0].T @ self.P @ x[0]
        g = x[0].T @ self.P @ (self.x[0] - self.prior)
        for i in range(count):
            H += w[i].T @ self.Q @ w[i] + v[i].T @ self.R @ v[i]
            g += w[i].T @ self.Q @ self.w[i] + v[i].T @ self.R @ self.v[i]
        rows, low, high, scale = [], [], [], []
        parts = (w, self.w), (v, self.v), (x, self.x)
        for name, (slopes, now) in zip(SET_NAMES, parts, strict=True):
            if name not in self.sets:
                continue
            matrix, lower, upper = self.sets[name]
            for slope, value in zip(slopes, now, strict=True):
                rows.append(matrix @ slope)
                low.append(lower - matrix @ value)
                high.append(upper - matrix @ value)
                scale.append(self.scales(name))
        if not rows:
            return H, g, np.zeros((0, n * (count + 1))), np.zeros(0), np.zeros(0), np.zeros(0)
        rows, low, high, scale = map(np.concatenate, (rows, low, high, scale))
        there = np.isfinite(low) | np.isfinite(high)
        return H, g, rows[there], low[there], high[there], scale[there]

    def deviations(self, name):
        """Standard deviations of the rows of a set."""
        weight = dict(zip(SET_NAMES, (self.Q, self.R, self.P), strict=True))[name]
        matrix = self.sets[name][0]
        return np.sqrt(np.diag(matrix @ np.linalg.inv(weight) @ matrix.T))

    def scales(self, name):
        """What a miss of each row of a set counts in."""
        _, lower, upper = self.sets[name]
        deviation, width = self.deviations(name), upper - lower
        return np.where(width > 0, np.minimum(width, deviation), deviation)

    def in_units(self, of_x, of_y):
        """The same QP with states and outputs in other units."""
        X, Y = np.diag(1 / of_x), np.diag(1 / of_y)
        units = dict(zip(SET_NAMES, (X, Y, X), strict=True))
        sizes = dict(zip(SET_NAMES, (of_x, of_y, of_x), strict=True))
        sets = {}
        for name, (matrix, lower, upper) in self.sets.items():
            d = len(units[name])
            # Components stay components: their limits change; of other rows, the coefficients.
            other = matrix @ units[name]
            factor = np.append(sizes[name], np.ones(len(matrix) - d))
            sets[name] = factor[:, None] * other, factor * lower, factor * upper
        return WindowQP(
            X @ self.P @ X, X @ self.Q @ X, Y @ self.R @ Y, self.prior * of_x, self.x * of_x,
            self.w * of_x, self.v * of_y, of_x[:, None] * self.A @ X, of_y[:, None] * self.C @ X,
            sets,
        )


class CSolver:
    """The solver in C for QPs of given sizes; ``general``: rows of each set beside components."""

    def __init__(self, n, p, horizon, general, real="double"):
        x = ca.SX.sym("x", n)
        system = qpmhe.from_casadi(
            ca.Function("f", [x], [x]), ca.Function("h", [x], [ca.repmat(x[0], p)]), compiled=False
        )
        sets = tuple((one is not None, one or 0) for one in general)
        gains = (("gain", False, n * p), ("filter_gain", False, n * p))
        self.layout = Layout(
            n, p, 0, horizon, sets, real, numbers_of=(("observer", gains),)
        )
        files = estimator_files(
            system.symbolic, self.layout, np.zeros((), self.layout.settings_type())
        )
        files["mhe.c"] += HOOK
        self._library = compiled_library(files, "mhe.c")
        sizes = np.zeros(5, np.int64)
        self._library.mhe_sizes(ctypes.c_void_p(sizes.ctypes.data))
        self._memory = [np.zeros(int(size), np.uint8) for size in sizes[:2]]

    def __call__(self, qp, limit=50, tolerance=1e-9, nearest=False, places=None):
        """Status, increments d and iterations; ``places`` is the first guess of active rows."""
        if places is None:
            places = np.zeros(self.layout.rows, np.int8)
        n, _, count = qp.sizes
        settings = np.zeros((), self.layout.settings_type())
        settings["prior_weight"], settings["disturbance_weight"] = qp.P.ravel(), qp.Q.ravel()
        settings["noise_weight"] = qp.R.ravel()
        settings["solver_tolerance"], settings["max_iterations"] = tolerance, limit
        settings["discount"] = 1.0
        for name, (matrix, lower, upper) in qp.sets.items():
            part, d, scale = settings[name], matrix.shape[1], qp.scales(name)
            part["lower"], part["upper"], part["scale"] = lower[:d], upper[:d], scale[:d]
            rows = len(matrix) - d
            part["rows"][: rows * d] = matrix[d:].ravel()
            part["row_lower"][:rows], part["row_upper"][:rows] = lower[d:], upper[d:]
            part["row_scale"][:rows] = scale[d:]
            deviation = qp.deviations(name)
            part["deviation"], part["row_deviation"][:rows] = deviation[:d], deviation[d:]
        kind = self.layout.number
        arrays = [
            np.ascontiguousarray(one, kind)
            for one in (qp.prior, qp.x, qp.w, qp.v, qp.A, qp.C)
        ]
        step = np.zeros((count + 1, n), kind)
        pointers = [ctypes.c_void_p(one.ctypes.data) for one in (*self._memory, settings)]
        found = self._library.solve(
            *pointers, ctypes.c_int32(count),
            *(ctypes.c_void_p(one.ctypes.data) for one in (*arrays, step)),
            ctypes.c_int32(nearest), ctypes.c_void_p(places.ctypes.data),
        )
        return found % 4, step.ravel(), found // 4


def random_qp(rng, n, p, count, general, tight=1.0, equal=0.0, open_share=0.3, redundant=0.3):
    """A QP with a point in all rows; the larger ``tight`` (in deviations), the fewer are active.

    A share of the rows is ``equal``, open on one side or both, and a repetition or combination
    of the others.
    """

    def weight(d):
        basis = np.linalg.qr(rng.normal(size=(d, d)))[0]
        return (basis * 10 ** rng.uniform(-1, 1, d)) @ basis.T

    qp = WindowQP(
        weight(n), weight(n), weight(p), rng.normal(size=n), rng.normal(size=(count + 1, n)),
        rng.normal(size=(count, n)), rng.normal(size=(count, p)),
        rng.normal(size=(count, n, n)) / np.sqrt(n), rng.normal(size=(count, p, n)),
    )
    inside = 0.5 * rng.normal(size=n * (count + 1))
    parts = zip(SET_NAMES, qp.residual_matrix(), (qp.w, qp.v, qp.x), general, strict=True)
    for name, slopes, now, rows in parts:
        if rows is None:
            continue
        d = now.shape[1]
        matrix = np.vstack((np.eye(d), rng.normal(size=(rows, d))))
        for r in range(d, d + rows):
            if rng.random() < redundant:
                matrix[r] = matrix[rng.integers(r)] * rng.choice([1.0, -2.0])
        # The limits are the same at all stages: the points inside at all of them.
        values = (now + slopes @ inside) @ matrix.T
        low, high = values.min(axis=0), values.max(axis=0)
        size = tight * np.linalg.norm(matrix, axis=1)
        low, high = low - size * rng.exponential(size=len(low)), high + size * rng.exponential(
            size=len(low))
        low[rng.random(len(low)) < open_share] = -np.inf
        high[rng.random(len(low)) < open_share] = np.inf
        qp.sets[name] = matrix, low, high
    if equal:
        _make_equal(rng, qp, inside, equal)
    return qp


def _make_equal(rng, qp, inside, share):
    """Shift the trajectory's residuals so that some rows of W or V are equations at ``inside``."""
    slopes = dict(zip(SET_NAMES, qp.residual_matrix(), strict=True))
    for name, now in (("disturbances", qp.w), ("noises", qp.v)):
        if name not in qp.sets:
            continue
        matrix, low, high = qp.sets[name]
        d = now.shape[1]
        for j in range(d):
            if rng.random() < share:
                value = rng.normal()
                now[:, j] = value - (slopes[name] @ inside)[:, j]
                low[j] = high[j] = value
        values = (now + slopes[name] @ inside) @ matrix.T
        fixed = low == high
        low[~fixed] = np.minimum(low, values.min(axis=0))[~fixed]
        high[~fixed] = np.maximum(high, values.max(axis=0))[~fixed]
