"""The interface of an auxiliary observer in output-injection form (eq:observer)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, field
from functools import partial
from types import NoneType
from typing import Any, NoReturn, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.values import shown

from .._checks import Array, positive_definite, positive_semidefinite, representation
from .._linalg import inverse
from ..errors import ModelError, OptionError, ShapeError
from ..model.sets import ConvexSet
from ..model.system import System
from ..model.tracing import Traced, traced
from .innovation import Counts, Innovation, Mask, Prediction, Verdict
from .roots import VAGUE, grown, least_share

#: Two inversions of a covariance change its correlations by no more.
SAME_COVARIANCE = 1e-9

_or = np.logical_or.reduce


@dataclass(slots=True)
class Sample:
    """The data of the stage at which an observer corrects.

    Parameters
    ----------
    system, u : System and (m,) array
        The model at this stage, and the input.
    f_jacobian, h_jacobian : (n, n) and (p, n) array or None
        Jacobians at z, if `Observer.needs_jacobians`.
    observed, noise_weight : (p,) bool and (p, p) array or None
        Which components of y are available, and a noise weight for this sample only; None if all
        are, or if it has none.
    covariance : (n, n) array or None
        Covariance of x(t) - z(t), if the observer has one.
    disturbance_weight : (r, r) array or None
        A disturbance weight for this sample only; None if it has none.
    states : ConvexSet or None
        The set X of this sample; None for the system's.
    rejections, next_rejections : (s,) int array or None
        Consecutive failures of each of the `Observer.sensors` before this sample, and an array into
        which `Observer.correct` writes the counts after it.
    root, next_root : (n, n) array or None
        An upper triangular U with U'U the covariance, where only U has all digits that matter, and
        where `Observer.correct` leaves the one of the next step.
    memory, next_memory : (k,) array or None
        What the observer remembers at this sample, read-only, and an array, first equal to it, into
        which `Observer.correct` writes what it remembers at the next; None if it has no
        `Observer.initial_memory`. To assign another array to ``next_memory`` is an error.
    """

    system: System
    u: Array
    f_jacobian: Array | None = None
    h_jacobian: Array | None = None
    observed: NDArray[np.bool_] | None = None
    noise_weight: Array | None = None
    covariance: Array | None = None
    disturbance_weight: Array | None = None
    states: ConvexSet | None = None
    rejections: Counts | None = None
    next_rejections: Counts | None = None
    root: Array | None = None
    next_root: Array | None = None
    memory: Array | None = None
    next_memory: Array | None = None


def check_written(observer: Observer, sample: Sample, given: Array) -> None:
    """Check that ``correct`` has written into the array for what the observer remembers next.

    Raises
    ------
    ModelError
        If it has assigned another array to ``sample.next_memory``, which nobody would read.
    """
    if sample.next_memory is not given:
        raise ModelError(
            f"{type(observer).__name__}.correct assigned sample.next_memory; expected that it "
            "writes into this array, sample.next_memory[...] = value: an array that is assigned "
            "is not remembered."
        )


@dataclass(frozen=True, slots=True)
class ObserverForm:
    """An observer as the step in C computes it: by ``codegen/c/observer_NAME.c``.

    That part has two functions: ``mhe_correction``, L(z, v) of a stage and what the observer
    remembers behind it, and ``mhe_filter``, its estimate of x(t) that has used y(t). Without a
    covariance it also has ``mhe_correction_slope``: the constant gain, or the slope of L between
    v = 0 and each of ``settings->noise_deviations``. With deviations and a rule for innovations it
    has ``mhe_predict_outputs`` and ``mhe_predict_deviations``, too.

    Parameters
    ----------
    name : str
        NAME.
    data : mapping
        The observer's numbers, ``settings->observer`` there: real ones, or integers of 32 bits.
    correction : callable or None
        The CasADi form of a function L(z, v), from the sizes of its arguments.
    prior, disturbance, noise : (n, n), (r, r) and (p, p) array or None
        Covariances of the initial error, of w and of v, of an observer with a covariance.
    deviations : int
        Rows of deviations with which a Kalman filter represents its covariance, where that loses
        digits: ``codegen/c/kalman.c`` computes with them. 0 for other observers.
    innovation : Innovation or None
        How a Kalman filter tests its innovations.
    plain : ObserverForm or None
        The form of the same observer without its covariance, for an estimator that does not read
        it; None if the correction does.
    """

    name: str
    data: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    correction: Callable[[int, int], Traced] | None = None
    prior: Array | None = None
    disturbance: Array | None = None
    noise: Array | None = None
    deviations: int = 0
    innovation: Innovation | None = None
    plain: ObserverForm | None = None


class _Unread:
    """In place of a `Sample`, while a correction is traced: notes what is read of it."""

    read = ""

    def __getattr__(self, name: str) -> NoReturn:
        if not name.startswith("__"):
            self.read = self.read or name
        raise AttributeError(name)


def _correction(
    correct: Callable[..., tuple[Any, Any]], sample: _Unread, z: Array, v: Array
) -> Any:
    """The correction of an observer without a covariance."""
    return correct(z, v, sample)[0]


class Observer(ABC):
    r"""An observer :math:`z(t+1) = f(z, u) + L(z, y - h(z, u))` with :math:`L(\cdot, 0) = 0`.

    The object itself remembers nothing: what an observer needs from sample to sample, a covariance
    or a memory of its own, passes through `correct` and is stored in the estimator's window. Thus
    late measurements, resets, snapshots and steps that were interrupted find it as it was.
    """

    #: Whether `correct` reads the Jacobians of f and h at z.
    needs_jacobians: bool = False

    _metric: Array | None = None

    def __repr__(self) -> str:
        return representation(self)

    @abstractmethod
    def check(self, system: System, initial_state: Array) -> None:
        """Raise an `InvalidInputError` if it does not fit the system and initial_state, z(0)."""

    @property
    def constant_gain(self) -> Array | None:
        """The gain K (n, p) of an observer whose correction is K v at all times; None otherwise."""
        return None

    @property
    def metric(self) -> Array | None:
        """A metric M (n, n) in which the error provably contracts; None if none is known.

        The observer is projected onto X in this metric, so that the proof also holds with X.
        """
        return self._metric

    @metric.setter
    def metric(self, value: Array | None) -> None:
        """Keep a metric of an observer of your own; the estimator checks it."""
        self._metric = value

    def _check_metric(self, system: System) -> None:
        """Check the size of a metric that was given."""
        if self._metric is not None and self._metric.shape[0] != system.n:
            raise ShapeError(
                f"metric has shape {self._metric.shape}; expected ({system.n}, {system.n}), "
                "for the states."
            )

    def initial_covariance(self) -> Array | None:
        """The covariance (n, n) of the initial estimate; None for observers without one."""
        return None

    def initial_memory(self) -> Array | None:
        """What it remembers before the first sample (k,); None for observers without a memory.

        `correct` finds it in `Sample.memory`, and writes into `Sample.next_memory`.
        """
        return None

    @property
    def sensors(self) -> tuple[tuple[int, ...], ...]:
        """The outputs of each sensor whose consecutive failures it counts."""
        return ()

    @property
    def rejects(self) -> bool:
        """Whether failing sensors are rejected."""
        return False

    @property
    def propagates_roots(self) -> bool:
        """Whether `correct` continues from `Sample.root` where there is one."""
        return False

    @property
    def innovation_limit(self) -> float | None:
        """The largest fully weighted innovation of one output, in standard deviations."""
        return None

    @abstractmethod
    def correct(self, z: Array, v: Array, sample: Sample) -> tuple[Array, Array | None]:
        """The correction L(z, v) and the covariance of the next step.

        Parameters
        ----------
        z, v : (n,) and (p,) array
            Observer state z(t), and fitting error y(t) - h(z(t)), with zeros where y is missing.
        sample : Sample
            Further data of the stage; overwritten at the next stage.
        """

    @property
    def filter_gain(self) -> Array | None:
        """The gain G (n, p) of an observer whose estimate of x(t) is z + G v at all times.

        Zero without a measurement update; None for other measurement updates.
        """
        gain = self.constant_gain
        if gain is None or type(self).filter is not Observer.filter:
            return None
        return np.zeros_like(gain)

    @property
    def c_form(self) -> ObserverForm | None:
        """The observer's data for the step in C; None if C cannot compute it.

        A correction by z and v alone is traced: without a covariance, a memory, Jacobians, counted
        sensors and an estimate of its own that has used y(t).
        """
        gain, filter_gain = self.constant_gain, self.filter_gain
        if gain is not None:
            if filter_gain is None:
                return None
            return ObserverForm("gain", {"gain": gain, "filter_gain": filter_gain})
        has_more = (
            self.needs_jacobians or self.sensors or self.initial_covariance() is not None
            or self.initial_memory() is not None or type(self).filter is not Observer.filter
        )
        return None if has_more else ObserverForm("injection", correction=self._traced_correction)

    def _traced_correction(self, n: int, p: int) -> Traced:
        """`correct` as CasADi has it, if it reads z and v alone."""
        unread = _Unread()
        found = traced(partial(_correction, self.correct, unread), (n, p), name="correction")
        if unread.read:
            return Traced(None, f"it reads sample.{unread.read}")
        if found.function is not None and found.shape != (n,):
            return Traced(None, f"it has shape {found.shape}; expected ({n},)")
        return found

    def filter(self, z: Array, v: Array, sample: Sample) -> tuple[Array, Array] | None:
        """The estimate of x(t) that uses y(t), and its covariance; None if there is none.

        A Kalman filter's measurement update.

        Parameters
        ----------
        z, v : (n,) and (p,) array
            As for `correct`.
        sample : Sample
            As for `correct`.
        """
        return None


class KalmanType(Observer):
    """An observer with covariances of initial error (n, n), disturbance (r, r) and noise (p, p).

    The first two may be singular. r is n, or the number of columns of the system's
    ``disturbance_matrix``. The innovation is a `Gate`, a `HuberInnovation` or None.
    """

    def __init__(
        self, *, prior: ArrayLike, disturbance: ArrayLike, noise: ArrayLike,
        innovation: Innovation | None = None,
    ) -> None:
        self._prior, _ = positive_semidefinite("prior covariance", prior)
        self._disturbance, _ = positive_semidefinite("disturbance covariance", disturbance)
        self._noise = positive_definite("noise covariance", noise)
        self._share = least_share(self._noise)
        if not isinstance(innovation, (Innovation, NoneType)):
            raise OptionError(
                f"innovation is {shown(innovation)}; expected qpmhe.Gate(...), "
                "qpmhe.HuberInnovation(...) or None."
            )
        self._innovation = innovation
        self._sensors = () if innovation is None else innovation.sensors(len(self._noise))

    def check(self, system: System, initial_state: Array) -> None:
        """Check the covariances' dimensions; see `Observer.check`."""
        for name, matrix, size in (
            ("prior", self._prior, system.n),
            ("disturbance", self._disturbance, system.r),
            ("noise", self._noise, system.p),
        ):
            if matrix.shape[0] != size:
                raise ShapeError(
                    f"{name} covariance has shape {matrix.shape}; expected ({size}, {size})."
                )

    def initial_covariance(self) -> Array:
        """P(0)."""
        return self._prior

    def with_prior(self, prior: Array) -> Self:
        """The same observer with another P(0), (n, n), positive semidefinite."""
        found = copy(self)
        found._prior, _ = positive_semidefinite("prior covariance", prior, len(self._prior))
        return found

    @property
    def sensors(self) -> tuple[tuple[int, ...], ...]:
        """The outputs of each sensor of its gate; see `Observer.sensors`."""
        return self._sensors

    @property
    def rejects(self) -> bool:
        """Whether it has a gate."""
        return self._innovation is not None and self._innovation.rejects

    @property
    def innovation_limit(self) -> float | None:
        """The root of its rule's limit; see `Observer.innovation_limit`."""
        if self._innovation is None:
            return None
        return float(np.sqrt(self._innovation.limits(len(self._noise))[0]))

    def _form(
        self, name: str, deviations: int, data: Mapping[str, NDArray[Any]] | None = None
    ) -> ObserverForm:
        """The observer's C form, with its covariances."""
        return ObserverForm(
            name, data or {}, prior=self._prior, disturbance=self._disturbance, noise=self._noise,
            deviations=deviations, innovation=self._innovation,
        )

    def _judge(self, prediction: Prediction, noise: Array, v: Array, sample: Sample) -> Verdict:
        """How much the outputs that are there count; see `Innovation.judge`."""
        assert self._innovation is not None
        observed: Mask | None = sample.observed
        if observed is None:
            observed = np.ones(v.size, np.bool_)
        rejections = sample.rejections
        if rejections is None:
            rejections = np.zeros(len(self._sensors), np.int64)
        return self._innovation.judge(prediction, noise, v, observed, rejections)

    def _is_vague(self, spread: Array, noise: Array, sample: Sample) -> bool:
        """Whether S hides what the noise has in it: of several outputs, the gain is then lost."""
        if len(noise) < 2:
            return len(noise) == 1 and VAGUE * spread.item() > noise.item()
        share = self._share if sample.noise_weight is None else least_share(noise)
        # In one call, where `any` takes three.
        return bool(_or(VAGUE * spread.diagonal() > share * noise.diagonal()))

    @staticmethod
    def _used(sample: Sample, larger: Array | None) -> tuple[Array, Array | None]:
        """The covariance, or a larger one in its place, and its root where there is one."""
        covariance, root = sample.covariance, sample.root
        assert covariance is not None
        if larger is None:
            return covariance, root
        return larger, None if root is None else grown(root, covariance, larger)

    def _remember(self, verdict: Verdict, sample: Sample) -> None:
        """Write the counts behind this sample."""
        if sample.next_rejections is not None and verdict.rejections is not None:
            sample.next_rejections[...] = verdict.rejections

    def _noise_of(self, sample: Sample) -> Array:
        """The covariance of this sample's noise."""
        return covariance_of(sample.noise_weight, self._noise)

    def _disturbance_of(self, sample: Sample) -> Array:
        """The covariance (n, n) of what this sample's disturbance adds to the state."""
        own = covariance_of(sample.disturbance_weight, self._disturbance)
        return sample.system.state_covariance(own)


def covariance_of(weight: Array | None, usual: Array) -> Array:
    """The covariance of a sample's weight; the usual one if both are equal up to rounding.

    A weight computed from the usual covariance then gives the same digits as none.
    """
    if weight is None:
        return usual
    covariance = inverse(weight)
    deviations = np.sqrt(usual.diagonal())
    near = np.abs(covariance - usual) <= SAME_COVARIANCE * np.multiply.outer(deviations, deviations)
    return usual if near.all() else covariance
