"""The moving horizon estimator (Definition def:estimator)."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from time import perf_counter
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers import Solver
from qpmhe_solvers.errors import report_unknown_options
from qpmhe_solvers.values import integer, shown

from .._checks import count, flag, label_list, numbers, positive
from ..costs import Cost
from ..errors import InvalidInputError, OptionError, ShapeError
from ..model.sets import ConvexSet
from ..model.system import System
from ..model.traces import warn_of
from ..observers import Observer
from .branches import check_branches
from .conditions import Conditions
from .contracts import check_correction, check_observer, check_prior
from .engines import EngineChangeError, engine_for, engine_for_record
from .estimate import Estimate
from .estimator_memory import EstimatorMemory
from .reach import compared
from .run import Run, RunSource
from .sample_arguments import SampleArguments, with_parameters
from .settings import Settings
from .start import check_cost, nominal_parameters, require, with_scaled_constraints
from .step_length import StepCheck
from .time_index import names_of, paired_record

Array = NDArray[np.float64]


@report_unknown_options
class MovingHorizonEstimator(EstimatorMemory):
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
        factorisation and, only where inequalities are active, another solver or active sets on that
        factorisation; a named backend solves every QP. A solver made by ``qpmhe.solvers.create``
        keeps its cap and tolerances. Several estimators of one thread may share it; it starts cold
        whenever the estimator changes.
    max_qps : int or None
        QPs per sample, the paper's i; 0 gives the observer. None iterates to convergence; it
        ends before, with `Status.UNCONVERGED`, at 100 QPs, and without a cap on iterations or time
        at three in a row that the backend has not solved to its tolerance. Where a QP's step does
        not lower J at any length, which happens with inequalities, the next QP is damped, and
        counts. If inequalities are dropped, or the candidate is restored into the sets, at least
        one QP is solved after that, even beyond the cap.
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
        cache, see `qpmhe.compile`, and otherwise the Python step; it never warns, and accepts every
        option. Only `run` waits for a compiler, before a record so long that this is earned back.
        The property `engine` reports the choice.
    project_observer : bool
        Whether the observer's state is projected onto X after each step, in the observer's metric:
        `Observer.metric`, the inverse of its covariance, or the Lyapunov matrix of its linearised
        error. False gives the paper's plain observer, which may leave X.
    projection_metric : {"observer", "diagonal"}
        The metric of this projection: the observer's own, or the inverse of the diagonal of its
        covariance. The latter clips components to their bounds, and leaves the others as they are.
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
    restart : bool
        Whether the observer may be restarted from an estimate, at most once in N samples. At each
        sample a second observer runs over the window, from the estimate that was made of its first
        state before its measurements came, with the prior's covariance. It takes the first one's
        place where it has predicted these measurements far better, by an F-test of the squared
        errors. The status then has `Status.RESTARTED`, with which what the theorem and certificates
        prove ends. Each sample costs N observer steps more.
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
        standard deviation of the prior and within X, one step differs from two of half the length,
        or from solved ones of radau, by more than 0.1 standard deviations of the disturbance, or of
        the prior where there is no disturbance; with ``method="euler"``, a coarse map by choice, by
        more than 10. The input is the usual one, zero but for ``parameters``. Samples are not
        compared.

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
        projection_metric: str = "observer",
        infeasible: str = "drop_rows",
        warm_start: bool = False,
        candidate: str = "observer",
        time_budget: float | None = None,
        isolated: bool = False,
        arrival: str = "observer",
        parameters: ArrayLike | None = None,
        restart: bool = False,
    ) -> None:
        is_copy = "settings" in vars(self)  # from `__setstate__`: no warning is given twice
        self.settings = Settings(
            horizon, backend, max_qps, max_solver_iterations, solver_tolerance, tolerance,
            engine, project_observer, projection_metric, infeasible, warm_start, candidate,
            time_budget, isolated, arrival, nominal_parameters(parameters), restart,
        )
        self.system, self.observer, self.cost = system, observer, cost
        require(system, System, "system", "qpmhe.System")
        require(observer, Observer, "observer", "qpmhe.Luenberger or another observer")
        require(cost, Cost, "cost", "qpmhe.QuadraticCost or qpmhe.RobustCost")
        check_cost(system, cost)
        check_observer(system, observer)
        check_prior(observer, cost, warns=not is_copy and self.settings.max_qps != 0)
        own = system.evaluated_by(system.model(
            cost.prior_deviations(observer.initial_covariance(), system.disturbance_matrix)
        ))
        self._arguments = SampleArguments(system, cost, self.settings.parameters)
        self._takes_steps = False  # whether a step of another length has been tried
        self._step_check = StepCheck(cost, observer.initial_covariance())
        self._tries_inputs = not is_copy and self._arguments.inputs > 0
        # The system as this estimator evaluates it.
        self._initial_state: Array
        self._initial_state, self._own_system = self._checked_start(initial_state, own)
        self._first_state = self._initial_state  # which `reset` does not change
        self._labels = names_of(initial_state)
        if not is_copy:
            usual = self._arguments.usual_input
            check_correction(self._own_system, observer, cost, self._initial_state, usual)
            place = cost, observer.initial_covariance(), self._initial_state, usual
            self._step_check.warn(self._own_system, self._initial_state, usual, 3)
            check_branches(self._own_system, *place, 3)
            self._own_system = compared(self._own_system, *place, horizon)
        self._own_system = with_scaled_constraints(
            self._own_system, observer, cost, self._initial_state
        )
        try:
            self._engine = engine_for(
                self._own_system, observer, cost, self.settings, self._initial_state
            )
        except MemoryError as error:
            raise OptionError(
                f"horizon is {self.settings.horizon}: the arrays of this many stages of "
                f"{system.n} states do not fit into memory ({error}); take a shorter horizon."
            ) from error

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
        arguments = self._arguments
        own: Conditions | None = None
        if sensors is not None:
            y_array, own = arguments.sampled(y, sensors)
        elif type(y) is np.ndarray and y.shape == arguments.outputs and y.dtype == np.float64:
            y_array = y
        else:
            y_array = arguments.measurement(y)
        u_array = arguments.input
        if u is not None or parameters is not None or u_array.size:
            u_array = arguments.read_input(u, parameters, self._engine.usual)
        if dt is not None:
            dt = positive("dt", dt)
            self._check_step_length(dt)
        if not (noise_weight is None and disturbance_weight is None and bounds is None):
            found = arguments.conditions.read(
                self._engine.usual, noise_weight=noise_weight,
                disturbance_weight=disturbance_weight, bounds=bounds,
            )
            own = found if own is None else own.over(found)
        try:
            return self._engine.step(y_array, u_array, dt, own, began)
        except EngineChangeError as change:
            self._change_engine(change)
        return self._engine.step(y_array, u_array, dt, own, began)

    def verify(self) -> bool:
        """Compare the functions f and h, and others that are traced, with their traces now.

        An estimator evaluates expressions in the place of functions that can be traced. It compares
        both when it is made; later where values that the functions read have changed, at which it
        looks before the samples; and, without ``time_budget``, at each 1000th sample. This method
        compares them at the present state and at points of several magnitudes, whatever has
        changed, in some hundred microseconds. It also warns where the step of a discretised ODE is
        too long from the present state, with the newest inputs.

        Returns
        -------
        bool
            Whether they agree. If not, an `EngineWarning` names the function and the point, and the
            estimator evaluates the functions as they are written from now on.
        """
        self._step_check.warn(self._own_system, self.state, self._arguments.input, 2)
        try:
            return self._engine.verify(self._arguments.usual_input)
        except EngineChangeError as change:
            self._change_engine(change)
            return False

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
        reader = self._arguments.conditions
        changes = reader.read(
            usual, noise_weight=noise_weight, disturbance_weight=disturbance_weight,
            bounds=bounds, drop_usual=False,
        )
        values = None if parameters is None else reader.parameters(parameters, usual)
        return self._engine.set(changes, values)

    def check_inputs(self, inputs: ArrayLike) -> None:
        """Warn where inputs make the step of a discretised ODE too long.

        The estimator itself looks at its step with inputs of 0, when it is made. `run` calls this;
        call it before a loop of `update` with inputs that will come, or with each one: inputs are
        tried where they lie beyond those before, and there is a second warning only of an error
        that is ten times as large.

        Parameters
        ----------
        inputs : (T, m) array_like
            Of the finite ones, the first is tried, and those in which an input is largest or
            smallest.

        Raises
        ------
        ShapeError, InvalidInputError
            If they have another shape, or are no numbers.
        """
        us, m = numbers("inputs", inputs, finite=False), self._arguments.inputs
        if us.ndim != 2 or us.shape[1] != m:
            raise ShapeError(
                f"inputs has shape {us.shape}; expected (T, {m}), a row for each time."
            )
        self._check_inputs(us, 3)

    def _check_inputs(self, us: Array, level: int) -> None:
        new = self._step_check.new_inputs(us) if self._tries_inputs else us[:0]
        whole = with_parameters(new, len(new), self._engine.usual)
        if whole is not None and len(new):
            self._step_check.warn(self._own_system, self._initial_state, whole, level)

    def step_fault(self, estimate: Estimate) -> str:
        """Whether the model failed by the step of a discretised ODE, and what to do about it.

        Parameters
        ----------
        estimate : Estimate
            The newest one, whose status has MODEL_FAILED.

        Returns
        -------
        str
            A sentence; blank where the step is not far too long near the initial state and the
            observer's states in the window, with the newest inputs.
        """
        finite = np.isfinite(estimate.candidate).all(axis=1)
        states = self._initial_state, *estimate.candidate[finite]
        return self._step_check.explosion(self._own_system, states, self._arguments.input)

    def _check_step_length(self, dt: float) -> None:
        """Check once, before a sample is taken, that the model takes step lengths."""
        if not self._takes_steps:
            inputs = np.append(self._arguments.usual_input, dt)
            self._engine.system.timed.at(self._initial_state, inputs)
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
        return self._engine.amend(index, self._arguments.measurement(y))

    def run(
        self,
        measurements: ArrayLike,
        inputs: ArrayLike | None = None,
        *,
        covariances: bool = False,
        smoothed: int | None = None,
        time_unit: Any = "s",
        labels: Sequence[str] | None = None,
        may_compile: bool = True,
    ) -> Run:
        """Update with each sample of a record, starting at the current state.

        With ``engine="auto"``, an estimator without samples first compiles its step if so many are
        to come that this is earned back, by an estimate from its sizes, or takes a library that is
        in the cache by now. Calls of the compiler take a minute at most; where they fail,
        the Python step runs. `Run.engine_reason` has the reason.

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
        smoothed : int, optional
            A lag of 0 to N-1 samples: `Run.smoothed` then has the estimate of each x(t) that also
            uses so many measurements after t, as a fixed-lag smoother gives it.
        time_unit : str or pandas.Timedelta
            The model's unit of time, for an index of times and for figures: ``"s"``, ``"min"``,
            ``"h"``, ...
        labels : sequence of str, optional
            Names of the states, with units, for the run's page and figures. If left out, those of
            an ``initial_state`` that is a Series with names, else the model's.
        may_compile : bool
            Whether ``engine="auto"`` may change the engine before the first sample.

        Returns
        -------
        Run
            Estimates, costs, times and statuses of all steps.

        Raises
        ------
        ShapeError, InvalidInputError
            If a shape is wrong, or the times of measurements and inputs do not match or are no
            steps of the model; the estimator stays unchanged.
        OptionError
            If ``smoothed`` is no lag within the window.
        """
        flag("covariances", covariances)
        flag("may_compile", may_compile)
        labels = self._labels if labels is None else label_list(labels, self.system.n)
        if smoothed is not None:
            smoothed = count(
                "smoothed", smoothed, 0, most=self.horizon - 1,
                remedy=" A window of N samples has lags of up to N - 1.",
            )
        ys, us, lengths, index, _ = paired_record(
            self.system, measurements, inputs, self._arguments.inputs, time_unit
        )
        if us is None and self._arguments.inputs:
            self._arguments.read_input(None, None, self._engine.usual, "run(Y, U)")
        if us is not None:
            self._check_inputs(us, 3)
        whole = with_parameters(us, len(ys), self._engine.usual)
        at_once, reason = None, ""
        if may_compile:
            self._engine, reason = engine_for_record(
                self._engine, self._own_system, self.observer, self.cost, self.settings, len(ys)
            )
        try:
            if not covariances and smoothed is None and lengths is None:
                at_once = self._engine.run(ys, whole)
        except EngineChangeError as change:
            self._change_engine(change)
        if at_once is not None:
            at_once.source = self.run_source(ys, whole, None, time_unit, labels)
            at_once.index, at_once.engine_reason = index, reason
            return at_once
        run = Run.by_updates(self, ys, us, lengths, covariances, smoothed)
        run.source, run.index = self.run_source(ys, whole, lengths, time_unit, labels), index
        run.engine_reason = reason
        return run

    def run_source(
        self, measurements: Array, inputs: Array | None, steps: Array | None = None,
        time_unit: Any = "s", labels: Sequence[str] | None = None,
    ) -> RunSource:
        """The source of a run that is assembled from single updates.

        Parameters
        ----------
        measurements, inputs, steps, time_unit, labels
            As for `RunSource`.
        """
        system, cost = self._engine.usual.applied(self._engine.system, self.cost)
        return RunSource(
            system, self.observer, cost, self.settings, measurements, inputs, steps, time_unit,
            self._labels if labels is None else labels,
        )


_UPDATE = MovingHorizonEstimator.update.__code__
