"""The moving horizon estimator (Definition def:estimator)."""

from __future__ import annotations

import pickle
import sys
import warnings
from collections.abc import Mapping
from dataclasses import fields
from time import perf_counter
from types import FrameType
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers import Solver
from qpmhe_solvers.errors import report_unknown_options
from qpmhe_solvers.values import integer, shown

from .._checks import flag, numbers, positive, vector
from .._linalg import inverse
from ..costs import Cost
from ..errors import InvalidInputError, ModelError, ObserverWarning, OptionError, ShapeError
from ..memory.snapshot import read, written
from ..model.sets import ConvexSet
from ..model.system import System
from ..model.traces import warn_of
from ..observers import Observer
from ..observers.projection import NearestPoint
from ..terms.hold import WindowHold
from .conditions import ConditionReader, Conditions
from .contracts import check_correction, check_observer, check_prior
from .engines import EngineChangeError, engine_for, engine_of_snapshot
from .estimate import Estimate
from .problem import Solved
from .run import Run, RunSource
from .settings import Settings
from .step_length import step_error, warn_of_step
from .time_index import paired_record

if TYPE_CHECKING:
    from ..sensitivity import Sensitivity

Array = NDArray[np.float64]


@report_unknown_options
class MovingHorizonEstimator:
    r"""Suboptimal moving horizon estimation with an observer-based candidate.

    Each measurement advances the auxiliary observer. Its last N steps are the candidate for the
    estimation problem (eq:optiMHE), and their first state is the prior. A sequence of convex QPs
    then improves the candidate. An iterate is accepted only if it satisfies the constraints and its
    true cost J is no greater than the candidate's (eq:estimator); otherwise the candidate is the
    estimate. ``infeasible`` sets what happens if the candidate itself violates a set. Under the
    assumptions of the paper's theorem the estimator is robustly exponentially stable for every
    horizon, solver and cap.

    Parameters
    ----------
    system : System
        The model and its sets.
    observer : Observer
        The auxiliary observer, such as `Luenberger`.
    cost : Cost
        `QuadraticCost` or `RobustCost`. Without a prior it needs an observer that has a covariance,
        see `ObserverPrior`; a constant prior beside such an observer gives a `PriorWarning`, unless
        no QP is solved.
    horizon : int
        N >= 1. While there are fewer than N samples, all are used (Remark rem:emtpyN).
    initial_state : (n,) array_like
        Estimate of x(0), the state at the first measurement. A state outside the set X is projected
        onto it, with an `ObserverWarning`.
    backend : str or Solver
        QP solver, one of ``qpmhe.solvers.available()``. ``auto`` uses a banded Cholesky
        factorisation and another solver only where inequalities are active; a named backend solves
        every QP. A solver made by ``qpmhe.solvers.create`` keeps its cap and tolerances. Several
        estimators of one thread may share it; it starts cold whenever the estimator changes.
    max_qps : int or None
        QPs per sample, the paper's i; 0 gives the observer. None iterates to convergence; it
        ends before, with `Status.UNCONVERGED`, at 100 QPs, and without a cap on iterations or time
        at three in a row that the backend has not solved to its tolerance. Where a QP's step does
        not lower J at any length, the next QP is damped, and counts. If inequalities are
        dropped, or the candidate is restored into the sets, at least one QP is solved after that,
        even beyond the cap.
    max_solver_iterations : int or None
        Cap on the solver's own iterations in each QP; None leaves the solver's default, or the
        cap of the solver given as ``backend``.
    solver_tolerance : float
        Tolerance on the QP's scaled, dimensionless residuals; see `qpmhe.solvers.SolverOptions`. If
        left out, a solver given as ``backend`` keeps its own.
    tolerance : float
        The sequence of QPs has converged when a QP solved to its tolerance lowers J by less than
        this fraction of J.
    engine : {"auto", "python", "compiled"}
        ``compiled`` generates C code for the whole step, compiles it once and caches it on disk. It
        raises an error that names any feature without a C form; without a C compiler it warns and
        falls back to the Python step. ``auto`` uses the compiled step if its library is in the
        cache, see `qpmhe.compile`, and otherwise the Python step; it never waits for a compiler,
        never warns, and accepts every option. The property `engine` reports the choice.
    project_observer : bool
        Whether the observer's state is projected onto X after each step, in the observer's metric:
        `Observer.metric`, the inverse of its covariance, or the Lyapunov matrix of its linearised
        error. False gives the paper's plain observer, which may leave X.
    infeasible : {"drop_rows", "restore"}
        What to do if the candidate violates a set and no trajectory satisfying all sets is found at
        a cost up to the candidate's. ``drop_rows`` leaves out, in this step only, the inequalities
        that the candidate violates. ``restore`` first looks for the nearest trajectory that
        satisfies all sets, and lowers the cost from there: the sets come before the cost, which may
        then be above the candidate's. The paper's theorem does not cover such a step.
    warm_start : bool
        Whether the sequence starts at the previous estimate, shifted by one step, if its true J is
        lower than the candidate's. Either way J(estimate) <= J(candidate).
    candidate : {"observer", "reinitialized"}
        The paper's candidate, or the trajectory of an observer that restarts at each sample from
        the estimate made N samples ago. The paper's theorem does not cover the latter, its outlook.
    time_budget : float or None
        Seconds for one update: no QP starts later, and backends with a time limit stop.
    isolated : bool
        Whether the backend solves in a separate process, so that a crash of compiled code only
        fails the QP, and the time budget stops any backend. It adds some tenths of a millisecond to
        each QP. Not for ``engine="compiled"``, which needs no backend.
    arrival : {"observer", "smoothed"}
        The mean of the prior: the observer's z(t-N) or, once the window moves, the previous
        window's ``smoothed`` estimate of the same state. The theorem does not cover the latter:
        this estimate already uses N - 1 of the window's measurements, so they count twice. The
        candidate stays the observer's trajectory, and its J then has a prior term. If a loss is not
        finite there, the step uses z(t-N).
    parameters : (k,) array_like, optional
        Usual values of the model's parameters, the last k of the system's m inputs; ``u`` then has
        m - k numbers. They hold until `set` changes them; `update` takes values for a single
        sample.

    Raises
    ------
    InvalidInputError
        If an argument is invalid; the subclass says how (see `qpmhe.errors`).

    Warns
    -----
    ModelWarning
        If the step of a discretised ODE is too long: at the initial state, or at points within one
        standard deviation of the prior and within X, one step differs from two of half the length
        by more than 0.1 standard deviations of the disturbance, or of the prior where there is no
        disturbance; with ``method="euler"``, a coarse map by choice, by more than 1. The input is
        the usual one, zero but for ``parameters``. Samples are not compared.

    Examples
    --------
    >>> import numpy as np, qpmhe
    >>> system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1)
    >>> cost = qpmhe.QuadraticCost(prior=1.0, disturbance=10.0, noise=1.0)
    >>> mhe = qpmhe.MovingHorizonEstimator(
    ...     system, qpmhe.Luenberger([0.3]), cost, horizon=5, initial_state=[0.0])
    >>> estimate = mhe.update([1.0])
    >>> estimate.improved
    True
    """

    #: Differentiates a solved problem; `qpmhe.sensitivity`, which stands on this room, has it.
    differentiate: ClassVar[type[Sensitivity]]

    def __init__(
        self,
        system: System,
        observer: Observer,
        cost: Cost,
        *,
        horizon: int,
        initial_state: ArrayLike,
        backend: str | Solver = "auto",
        max_qps: int | None = 1,
        max_solver_iterations: int | None = None,
        solver_tolerance: float = 1e-7,
        tolerance: float = 1e-9,
        engine: str = "auto",
        project_observer: bool = True,
        infeasible: str = "drop_rows",
        warm_start: bool = False,
        candidate: str = "observer",
        time_budget: float | None = None,
        isolated: bool = False,
        arrival: str = "observer",
        parameters: ArrayLike | None = None,
    ) -> None:
        is_copy = "settings" in vars(self)  # from `__setstate__`: no warning is given twice
        self.settings = Settings(
            horizon, backend, max_qps, max_solver_iterations, solver_tolerance, tolerance,
            engine, project_observer, infeasible, warm_start, candidate, time_budget,
            isolated, arrival, _nominal(parameters),
        )
        self.system, self.observer, self.cost = system, observer, cost
        _require(system, System, "system", "qpmhe.System")
        _require(observer, Observer, "observer", "qpmhe.Luenberger or another observer")
        _require(cost, Cost, "cost", "qpmhe.QuadraticCost or qpmhe.RobustCost")
        check_cost(system, cost)
        check_observer(system, observer)
        check_prior(observer, cost, warns=not is_copy and self.settings.max_qps != 0)
        own = system.evaluated_by(system.model(
            cost.prior_deviations(observer.initial_covariance(), system.disturbance_matrix)
        ))
        nominal = self.settings.parameters
        if len(nominal) > system.m:
            raise ShapeError(
                f"parameters has {len(nominal)} numbers; expected at most {system.m}, the system's "
                "known inputs: parameters are the last of these. Make the system with a larger m."
            )
        self._inputs = system.m - len(nominal)  # numbers in the u of `update`
        self._usual_input = np.append(np.zeros(self._inputs), nominal)
        self._full_input = self._usual_input.copy()  # each sample's, overwritten
        self._reader, self._partial = ConditionReader(system, cost), np.empty(system.p)
        self._sensors = (system.p,)
        self._takes_steps = False  # whether a step of another length has been tried
        # The system as this estimator evaluates it.
        self._initial_state: Array
        self._initial_state, self._own_system = self._checked_start(initial_state, own)
        self._first_state = self._initial_state  # which `reset` does not change
        if not is_copy:
            check_correction(
                self._own_system, observer, cost, self._initial_state, self._usual_input
            )
            error = step_error(
                self._own_system, cost, observer.initial_covariance(), self._initial_state,
                self._usual_input,
            )
            warn_of_step(error, system, 3)
        try:
            self._engine = engine_for(
                self._own_system, observer, cost, self.settings, self._initial_state
            )
        except MemoryError as error:
            raise OptionError(
                f"horizon is {self.settings.horizon}: the arrays of this many stages of "
                f"{system.n} states do not fit into memory ({error}); take a shorter horizon."
            ) from error


    def _checked_start(
        self, initial_state: ArrayLike, system: System
    ) -> tuple[Array, System]:
        state = vector("initial_state", initial_state, system.n)
        return check_start(system, self.observer, self.cost, state, u=self._usual_input)

    def reset(self, initial_state: ArrayLike | None = None) -> None:
        """Forget all measurements and restart.

        Parameters
        ----------
        initial_state : (n,) array_like, optional
            A new initial estimate; the former one if left out. Both are projected onto the X that
            `set` has left.

        Raises
        ------
        InvalidInputError
            If the state is invalid; the estimator stays unchanged.
        """
        before, state, system = self._initial_state, self._initial_state, None
        if initial_state is not None:
            state, system = self._checked_start(initial_state, self._engine.system)
        try:
            self._initial_state = state
            # X may be another one than that in which the former state is.
            start, _ = _inside(self._engine.system, self.observer, self.cost, state)
            self._engine.reset(start, system)
        except BaseException:
            self._initial_state = before
            raise

    @property
    def initial_state(self) -> Array:
        """The initial estimate, a copy."""
        return self._initial_state.copy()

    @property
    def state(self) -> Array:
        """The current estimate of x(t+1), or the initial one before the first measurement."""
        return self._engine.state

    @property
    def observer_state(self) -> Array:
        """z(t+1), the state from which the observer continues; at first the initial state."""
        return self._engine.observer_state

    @property
    def engine(self) -> str:
        """The engine in use, ``python`` or ``compiled``, also with ``engine="auto"``."""
        return self._engine.name

    @property
    def time(self) -> int:
        """Number of measurements taken so far."""
        return self._engine.time

    @property
    def horizon(self) -> int:
        """The horizon N."""
        return self.settings.horizon

    @property
    def inputs(self) -> int:
        """Number of inputs in the ``u`` of `update`: the system's inputs without the parameters."""
        return self._inputs

    @property
    def has_changed(self) -> bool:
        """Whether `set` has changed weights or bounds from those of ``cost`` and ``system``."""
        usual = self._engine.usual
        weights = usual.noise_weight, usual.disturbance_weight
        return usual.has_bounds or any(one is not None for one in weights)

    @property
    def usual(self) -> Conditions:
        """What `set` has changed, and the parameters."""
        return self._engine.usual

    @property
    def hold(self) -> WindowHold | None:
        """How the last step held parameters, see `augment_parameters`.

        None where nothing is held: without ``hold``, without QPs, or before the first measurement.
        """
        if not (self.system.held and self.time):
            return None
        return self._engine.solved().problem.hold

    def update(
        self,
        y: ArrayLike | None,
        u: ArrayLike | None = None,
        *,
        dt: float | None = None,
        noise_weight: ArrayLike | None = None,
        disturbance_weight: ArrayLike | None = None,
        bounds: Mapping[str, ConvexSet] | None = None,
        parameters: ArrayLike | None = None,
        sensors: ArrayLike | None = None,
    ) -> Estimate:
        """Take the measurement y(t) and the input u(t), and estimate x(t+1).

        Solver failures, a model that cannot be evaluated and missing measurements do not raise: the
        step falls back to the candidate, and the estimate's status says why. An update interrupted
        by Ctrl+C leaves the estimator as before the sample, but a QP solver loses its warm start.

        Parameters
        ----------
        y : (p,) array_like
            y(t), or a scalar if p is 1. Components count as missing if they are masked, None,
            pandas' NA or NaT, not finite, or so large that their square is not finite. With
            ``sensors``, only these components.
        u : (m,) array_like, optional
            u(t), the input that acts from t to t+1 (and on y(t), if h depends on it), without the
            estimator's parameters. Required if the system has such inputs; otherwise leave it out.
        dt : float, optional
            Length of the step from t to t+1, if not the sampling time; for systems made by
            `System.from_ode`.
        noise_weight, disturbance_weight : (p, p) and (r, r) array_like, optional
            Weights of this sample's v(t) and w(t), in place of the cost's. Kalman-type observers
            take their inverses as covariances.
        bounds : dict, optional
            Sets for this sample, by ``"states"``, ``"disturbances"`` and ``"noises"``: the system's
            with other sides. A `Box` changes the bounds of components, a `Polytope` the sides of
            the general inequalities, ``box & polytope`` both. x(t+1) keeps this sample's bounds
            until the next sample brings its own or the usual ones.
        parameters : (k,) array_like, optional
            Values of the parameters at this sample, in place of the usual ones.
        sensors : int, array_like of int or (p,) array_like of bool, optional
            The components of y that were sampled, in the order of ``y``; all if left out. The
            others are not missing, but have no measurement at this time.

        Returns
        -------
        Estimate
            Trajectory, cost, status and times.

        Raises
        ------
        ShapeError, WeightError, OptionError, SetError, InvalidInputError
            If an argument is invalid, or an update of this estimator runs already; the estimator
            stays unchanged.

        Notes
        -----
        Each sample keeps its weights, bounds, parameters and step length while it is in the window;
        `set` changes them for all samples.
        """
        began = perf_counter()
        # A flag would have to be reset behind the step, where an interrupt may leave it.
        caller: FrameType | None = sys._getframe(1)
        while caller is not None:
            if caller.f_code is _UPDATE and caller.f_locals["self"] is self:
                raise InvalidInputError(
                    "update was called within an update of the same estimator: by its own model, "
                    "observer, cost or solver. Take another estimator there."
                )
            caller = caller.f_back
        own: Conditions | None = None
        if sensors is not None:
            y_array, own = self._sampled(y, sensors)
        elif type(y) is np.ndarray and y.shape == self._sensors and y.dtype == np.float64:
            y_array = y
        else:
            y_array = self._measurement(y)
        needed = u is not None or parameters is not None or self._full_input.size
        u_array = self._input(u, parameters) if needed else self._full_input
        if dt is not None:
            dt = positive("dt", dt)
            self._check_step_length(dt)
        if not (noise_weight is None and disturbance_weight is None and bounds is None):
            found = self._reader.read(
                self._engine.usual, noise_weight=noise_weight,
                disturbance_weight=disturbance_weight, bounds=bounds,
            )
            own = found if own is None else own.over(found)
        try:
            return self._engine.step(y_array, u_array, dt, own, began)
        except EngineChangeError as change:
            self._change_engine(change)
        return self._engine.step(y_array, u_array, dt, own, began)

    def _change_engine(self, change: EngineChangeError) -> None:
        self._engine = change.engine
        warn_of(str(change), 4)

    def set(
        self,
        *,
        bounds: Mapping[str, ConvexSet] | None = None,
        noise_weight: ArrayLike | None = None,
        disturbance_weight: ArrayLike | None = None,
        parameters: ArrayLike | None = None,
    ) -> Estimate | None:
        """Change weights, bounds or parameters, for all samples of the window and all later ones.

        The observer reruns from the start of the window, and the current state is estimated again,
        as by an estimator made with these values that continues from there. Values given for single
        samples of the window are discarded. `reset` keeps the changes.

        Parameters
        ----------
        bounds, noise_weight, disturbance_weight, parameters : optional
            As for `update`; what is left out stays as it is.

        Returns
        -------
        Estimate or None
            The estimate of the same state as before, None before the first measurement.

        Raises
        ------
        ShapeError, WeightError, OptionError, SetError, InvalidInputError
            If an argument is invalid; the estimator stays unchanged.
        """
        usual = self._engine.usual
        changes = self._reader.read(
            usual, noise_weight=noise_weight, disturbance_weight=disturbance_weight,
            bounds=bounds, drop_usual=False,
        )
        values = None if parameters is None else self._reader.parameters(parameters, usual)
        return self._engine.set(changes, values)

    def _measurement(self, y: ArrayLike | None) -> Array:
        p = self.system.p
        return np.full(p, np.nan) if y is None else vector("y", y, p, finite=False)

    def _sampled(self, y: ArrayLike | None, sensors: ArrayLike) -> tuple[Array, Conditions | None]:
        """y(t) with NaN where it was not sampled, and the conditions that say so."""
        index, own = self._reader.sensors(sensors)
        self._partial.fill(np.nan)
        if y is not None:
            if type(y) is np.ndarray and y.ndim == 1 and y.dtype == np.float64:
                given = y
            else:
                given = np.atleast_1d(numbers("y", y, finite=False))
            if given.shape != index.shape:
                raise ShapeError(
                    f"y has shape {given.shape}; expected {index.shape}, a component for each of "
                    f"sensors={index.tolist()}."
                )
            self._partial[index] = given
        return self._partial, own

    def _input(
        self, u: ArrayLike | None, parameters: ArrayLike | None = None, call: str = "update(y, u)"
    ) -> Array:
        """u(t), the parameters behind the rest."""
        count, full = self._inputs, self._full_input
        if u is None:
            if count:
                raise InvalidInputError(
                    f"{call[-2]} is missing; the system has {count} "
                    f"input{'s' * (count != 1)}: {call}."
                )
        elif count == 0:
            beside = " beside its parameters" if self.system.m else ""
            raise InvalidInputError(
                f"u was given, but the system has no inputs{beside}; leave it out."
            )
        else:
            full[:count] = vector("u", u, count, finite=False)
        usual = self._engine.usual
        if parameters is not None:
            full[count:] = self._reader.parameters(parameters, usual)
        elif usual.parameters is not None:
            full[count:] = usual.parameters
        return full

    def _with_parameters(self, inputs: Array | None, samples: int) -> Array | None:
        """The inputs of a record, with the usual parameters behind them."""
        parameters = self._engine.usual.parameters
        if parameters is None:
            return inputs
        behind = np.tile(parameters, (samples, 1))
        return behind if inputs is None else np.hstack((inputs, behind))

    def _check_step_length(self, dt: float) -> None:
        """Check once, before a sample is taken, that the model takes step lengths."""
        if not self._takes_steps:
            self._engine.system.timed.at(self._initial_state, np.append(self._usual_input, dt))
            self._takes_steps = True

    def amend(self, time: int, y: ArrayLike) -> Estimate:
        """Insert a late measurement, rerun the observer from there, and estimate again.

        Parameters
        ----------
        time : int
            Index of the sample that it belongs to, one of the last N.
        y : (p,) array_like
            The measurement; its finite components replace the sample's.

        Returns
        -------
        Estimate
            The estimate of the same state as before, with this measurement.

        Raises
        ------
        ShapeError, InvalidInputError
            If the time is not within the window, or y is invalid; the estimator stays unchanged.
        """
        oldest, newest = self.time - self._engine.length, self.time - 1
        if newest < 0:
            raise InvalidInputError(
                f"time is {shown(time)}, but there is no sample yet; call update first."
            )
        index = integer(time)
        if index is None or not oldest <= index <= newest:
            raise InvalidInputError(
                f"time is {shown(time)}; expected an integer from {oldest} to {newest}, the "
                "samples in the window. Take a longer horizon for later measurements."
            )
        return self._engine.amend(index, self._measurement(y))

    def run(
        self,
        measurements: ArrayLike,
        inputs: ArrayLike | None = None,
        *,
        covariances: bool = False,
        time_unit: Any = "s",
    ) -> Run:
        """Update with each sample of a record, starting at the current state.

        Parameters
        ----------
        measurements : (T, p) array_like, DataFrame or Series
            y(t), ..., y(t+T-1); (T,) if p is 1. An index of times is the time axis: steps have its
            lengths, and samples without measurement fill gaps of whole steps.
        inputs : (T, m) array_like, DataFrame or Series, optional
            The inputs of the same times. Where both have an index of times, rows are paired by it,
            in any order; in gaps, inputs without a row of their own keep the last value.
        covariances : bool
            Whether to compute the covariance of each estimate; NaN where the model cannot
            be linearised along it.
        time_unit : str or pandas.Timedelta
            The model's unit of time, for an index of times: ``"s"``, ``"min"``, ``"h"``, ...

        Returns
        -------
        Run
            Estimates, costs, times and statuses of all steps.

        Raises
        ------
        ShapeError, InvalidInputError
            If a shape is wrong, or the times of measurements and inputs do not match or are no
            steps of the model; the estimator stays unchanged.
        """
        flag("covariances", covariances)
        ys, us, lengths, index, _ = paired_record(
            self.system, measurements, inputs, self._inputs, time_unit
        )
        if us is None and self._inputs:
            self._input(None, call="run(Y, U)")
        whole = self._with_parameters(us, len(ys))
        at_once = None
        try:
            if not covariances and lengths is None:
                at_once = self._engine.run(ys, whole)
        except EngineChangeError as change:
            self._change_engine(change)
        if at_once is not None:
            at_once.source, at_once.index = self.run_source(ys, whole), index
            return at_once
        start, observer_start = self.state.copy(), self.observer_state
        estimates, collected = [], []
        for t, y in enumerate(ys):
            estimates.append(self.update(
                y, None if us is None else us[t], dt=None if lengths is None else lengths[t]
            ))
            if covariances:
                collected.append(self._newest_covariance())
        n = self.system.n
        blocks = np.array(collected).reshape(-1, n, n) if covariances else None
        run = Run.of(start, estimates, blocks, observer_start=observer_start)
        run.source, run.index = self.run_source(ys, whole, lengths), index
        return run

    def run_source(
        self, measurements: Array, inputs: Array | None, steps: Array | None = None
    ) -> RunSource:
        """The source of a run that is assembled from single updates.

        Parameters
        ----------
        measurements, inputs, steps : array
            As for `RunSource`.
        """
        system, cost = self._engine.usual.applied(self._engine.system, self.cost)
        return RunSource(
            system, self.observer, cost, self.settings, measurements, inputs, steps
        )

    def covariances(self) -> Array:
        """Covariances of the last estimate's trajectory, by linearisation along it.

        The inverse of the Gauss-Newton Hessian's diagonal blocks, computed in O(N n^3):
        with inverse covariances as weights, the covariance of the error of each state given
        the window's measurements and the prior. Inequalities do not enter; noise-free
        components do.

        Returns
        -------
        (N_t + 1, n, n) array
            The last belongs to ``estimate.state``, the one before to ``estimate.filtered``.

        Raises
        ------
        InvalidInputError
            Before the first measurement, if the model cannot be linearised there, or if the
            weights leave a direction of the states undetermined: a redescending loss takes
            the weight from outliers.
        """
        return self._engine.covariances()

    def sensitivity(self) -> Sensitivity:
        """Derivatives of the last estimate with respect to weights, data and parameters.

        Applies the implicit function theorem to the window's true cost, with its exact Hessian and
        fixed active rows, for any engine. This takes a few factorisations of a banded matrix, O(N
        n^3), and one solve per derivative.

        Returns
        -------
        Sensitivity
            Its `Sensitivity.adjoint` differentiates any function of the trajectory with respect to
            everything at once.

        Raises
        ------
        InvalidInputError
            Before the first measurement, or if second derivatives do not exist along the
            estimate or are not known: of a cost that the user wrote, or of an active nonlinear
            constraint of more than the state.
        """
        return self._sensitivity_of(self._engine.solved())

    def _sensitivity_of(self, solved: Solved) -> Sensitivity:
        second = solved.formulation.system.evaluation.second_derivatives
        with np.errstate(all="ignore"):
            return self.differentiate(
                solved, second, self.settings.tolerance, len(self.settings.parameters)
            )

    def _newest_covariance(self) -> Array:
        try:
            value: Array = self.covariances()[-1]
        except InvalidInputError:  # bad luck: the record goes on
            value = np.full((self.system.n, self.system.n), np.nan)
        return value

    def state_dict(self) -> dict[str, Any]:
        """A snapshot of the estimator's memory: arrays by name, and one text for the rest.

        Save it with ``numpy.savez(file, **state)`` or ``json.dumps(state,
        default=numpy.ndarray.tolist)``. An estimator made with the same arguments continues from
        there after `load_state_dict`, in the same process or another: bit for bit, unless a QP
        solver was warm-started. What it keeps is not saved; see `forget_warm_start`. Taking a
        snapshot changes nothing in this estimator.

        Returns
        -------
        dict
            Copies, safe to keep, pickle or save.
        """
        return written(self._engine.state_dict())

    def forget_warm_start(self) -> None:
        """Have the next QP start without what the QP solver has kept of those before.

        An estimator that goes on after this call, and another that continues from its
        `state_dict`, give the same estimates to the last bit, whatever the solver. The compiled
        step needs no such call: snapshots have all that it keeps.
        """
        self._engine.forget_warm_start()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where another estimator stopped.

        Parameters
        ----------
        state : dict
            The `state_dict` of an estimator with the same arguments, also as read by ``numpy.load``
            or ``json.load``.

        Raises
        ------
        InvalidInputError
            If the state is damaged, or from an estimator with another model, observer, cost, sets,
            candidate or engine. The estimator stays unchanged. QP caps, backend, tolerances,
            ``infeasible`` and ``warm_start`` may differ.

        Notes
        -----
        A digest shows damage. Functions are compared by their values at a few points. With
        ``engine="auto"`` the estimator continues with the snapshot's engine.
        """
        memory = read(state)
        pinned = memory.get("engine")
        # Whole or, if interrupted, not at all.
        if isinstance(pinned, str) and self.engine != pinned and self.settings.engine == "auto":
            own = self._own_system.evaluated_like(self._engine.system)
            engine = engine_of_snapshot(
                pinned, own, self.observer, self.cost, self.settings, self._initial_state,
            )
            engine.load_state_dict(memory)
            self._engine = engine
        else:
            self._engine.load_state_dict(memory)

    def __repr__(self) -> str:
        parts = {"system": self.system, "observer": self.observer, "cost": self.cost}
        chosen = {
            field.name: value for field in fields(self.settings)
            if (value := getattr(self.settings, field.name)) != field.default
            and field.name != "engine"
        }
        words = [f"{name}={value!r}" for name, value in (
            parts | chosen | {"engine": self.engine, "time": self.time}
        ).items()]
        return "MovingHorizonEstimator(\n    " + ",\n    ".join(words) + "\n)"

    def __getstate__(self) -> dict[str, Any]:
        solver = self.settings.backend
        if isinstance(solver, Solver):
            try:
                pickle.dumps(solver)
            except Exception as error:
                raise InvalidInputError(
                    f"the solver {solver!r} given as backend cannot be pickled "
                    f"({type(error).__name__}: {error}), nor can its estimator; name "
                    "a registered backend instead, or save state_dict()."
                ) from error
        return {
            "arguments": (self.system, self.observer, self.cost),
            "settings": self.settings,
            "first_state": self._first_state,
            "initial_state": self.initial_state,
            "engine": self.engine,
            "state": self.state_dict(),
        }

    def __setstate__(self, saved: dict[str, Any]) -> None:
        # Construction checks everything again: a snapshot is input like any other.
        options = vars(saved["settings"]) | {"engine": saved["engine"]}
        self.settings = saved["settings"]  # what the first construction warned of is known
        self.__init__(  # type: ignore[misc]  # on a fresh, empty instance
            *saved["arguments"], initial_state=saved["first_state"], **options
        )
        self.settings = saved["settings"]
        self.load_state_dict(saved["state"])
        if not np.array_equal(saved["initial_state"], saved["first_state"]):
            # How the model is called and scaled depends on both; X is that of `set` by now.
            self.reset(saved["initial_state"])
            self.load_state_dict(saved["state"])


_UPDATE = MovingHorizonEstimator.update.__code__


def _nominal(parameters: ArrayLike | None) -> tuple[float, ...]:
    if parameters is None:
        return ()
    values = np.atleast_1d(numbers("parameters", parameters))
    if values.ndim != 1:
        raise ShapeError(
            f"parameters has shape {values.shape}; expected (k,), the usual values of the system's "
            "last k inputs."
        )
    return tuple(values.tolist())


def _require(value: object, kind: type, name: str, expected: str) -> None:
    if not isinstance(value, kind):
        raise InvalidInputError(f"{name} is {shown(value)}; expected a {expected}.")


def check_cost(system: System, cost: Cost) -> None:
    """Check that a cost is for the system's states, disturbances and outputs."""
    n = system.n if cost.observer_prior is not None and cost.r == system.r else cost.n
    if (n, cost.p) != (system.n, system.p):
        raise ShapeError(
            f"the cost is for {n} states and {cost.p} outputs; expected {system.n} and "
            f"{system.p}, the system's."
        )
    if cost.r != system.r:
        raise ShapeError(
            f"the cost is for {cost.r} disturbances; expected {system.r}, "
            + ("one for each state. Give the system a disturbance_matrix if there are fewer."
               if system.disturbance_matrix is None
               else "one for each column of the system's disturbance_matrix.")
        )


def check_start(
    system: System, observer: Observer, cost: Cost, state: Array, name: str = "initial_state",
    u: Array | None = None,
) -> tuple[Array, System]:
    """Check that model and observer work at an initial state.

    Returns the state, projected onto X, and the system as it is evaluated from there on.
    """
    try:
        start, is_moved = _inside(system, observer, cost, state)
        if is_moved:
            warnings.warn(
                f"{name} is {state.tolist()}, outside of the state set {system.states!r}; the "
                f"estimator starts at the nearest point of the set, {start.tolist()}.",
                ObserverWarning,
                stacklevel=4,
            )
        state = start
        system = system.at(state, np.zeros(system.m) if u is None else u)
        observer.check(system, state)
    except ModelError as error:
        if name == "initial_state":
            raise
        raise ModelError(f"{name}: {error}") from error
    return state, system


def _inside(
    system: System, observer: Observer, cost: Cost, state: Array
) -> tuple[Array, bool]:
    """An initial state in X, in its turn, and whether it was projected."""
    if system.states is None:
        return state, False
    if system.turns is not None:
        state = system.turns(state)
    nearest = NearestPoint(system.states)
    if nearest.contains(state):
        return state, False
    weight = observer.metric
    if weight is None:
        weight = cost.initial_weight(observer.initial_covariance())
    if weight.shape[0] != system.n:
        return state, False  # `Observer.check` then reports the wrong size
    return nearest(state, inverse(weight)).point, True
