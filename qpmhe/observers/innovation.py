"""Rules for innovations that the covariance of a Kalman-type observer does not explain."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.values import finite, integer, shown

from .._checks import Array, count, positive
from .._linalg import cholesky, solve, unit_diagonal
from ..errors import OptionError
from .roots import triangle, whitened

Mask = NDArray[np.bool_]
Counts = NDArray[np.int64]

#: Variances grow by a power of this factor, and by at most the one with this exponent: beyond it,
#: the covariance of the noise would be lost in rounding.
GROWTH, MOST_GROWTH = 4.0, 20

#: After so many times the usual number of failures, no sensor that passes keeps another one shut.
LONGEST = 10


@dataclass(frozen=True, slots=True)
class Prediction:
    """The observer's covariance, and its prediction of the q available outputs.

    Parameters
    ----------
    covariance, cross, spread : (n, n), (n, q) and (q, q) array
        P, :math:`P C'` and :math:`C P C'`.
    spread_of, deviations_of : callable
        The latter, and deviations X (k, q) and F (k, n) of outputs and states with the squares
        :math:`X'X = C P C'` and :math:`F'F = P`, from another P.
    is_hidden : callable
        Whether an innovation's covariance hides what the noise has in it; see `factor`.
    """

    covariance: Array
    cross: Array
    spread: Array
    spread_of: Callable[[Array], Array]
    deviations_of: Callable[[Array], tuple[Array, Array]]
    is_hidden: Callable[[Array], bool]

    def shares(self, places: list[int], noise: Array) -> Array:
        """By which share these outputs would reduce each variance, over the largest share."""
        cross, innovation = self.cross[:, places], self.spread + noise
        if len(places) > 1 and self.is_hidden(innovation):
            reduced = self.factor(self.covariance, places, noise)[:, len(places) :] ** 2
        else:
            reduced = cross.T * solve(innovation[np.ix_(places, places)], cross.T)
        variances = self.covariance.diagonal()
        found: Array = reduced.sum(axis=0) / np.where(variances > 0.0, variances, np.inf)
        most = found.max()
        return found / most if most > 0.0 else np.zeros_like(found)

    def factor(self, covariance: Array, places: list[int], noise: Array) -> Array:
        """U_S and U_S K', with the innovation's covariance U_S' U_S and gain K of some outputs.

        They come from another P, by roots: S itself may have no digit of the noise.
        """
        seen, states = self.deviations_of(covariance)
        q = len(places)
        rows = np.zeros((q + len(seen), q + states.shape[1]))
        rows[:q, :q] = cholesky(noise[np.ix_(places, places)]).T
        rows[q:, :q], rows[q:, q:] = seen[:, places], states
        return triangle(rows)[:q]

    def distance(
        self, innovation: Array, covariance: Array, noise: Array, v: Array, known: list[int],
        part: list[int],
    ) -> float:
        """The squared norm of a part of v in its covariance, given others; infinity if singular.

        ``innovation`` is the covariance of v that belongs to a P, ``covariance``.
        """
        if not known and len(part) == 1:
            return float(v[part[0]] * v[part[0]] / innovation[part[0], part[0]])
        both, count = known + part, len(known)
        if self.is_hidden(innovation):
            tail = whitened(self.factor(covariance, both, noise)[:, : len(both)], v[both])[count:]
            return float(tail @ tail)
        scaled, units, whole = unit_diagonal(innovation[np.ix_(both, both)])
        try:
            root = np.linalg.cholesky(scaled)
        except np.linalg.LinAlgError:
            return math.inf
        tail = np.linalg.solve(root, np.ldexp(v[both], -units))[count:]
        return float(np.ldexp(tail @ tail, -whole))

    def grown(self, growth: Array) -> Array:
        """P whose variances have grown by these factors (n,)."""
        scale = np.sqrt(growth)
        larger: Array = scale[:, None] * self.covariance * scale
        return larger


class Verdict(NamedTuple):
    """The data of an observer's correction.

    Parameters
    ----------
    covariance : (n, n) array or None
        A larger P; None for the one that it has.
    kept : (q,) bool array or None
        Which of the available outputs correct; None for all.
    noise : (q, q) array or None
        Covariance of the noise of all outputs that are there; None for the one that it has.
    rejections : (s,) int array or None
        Consecutive failures of each sensor, this sample included.
    """

    covariance: Array | None = None
    kept: Mask | None = None
    noise: Array | None = None
    rejections: Counts | None = None


#: Of an observer without a rule.
UNJUDGED = Verdict()


class Innovation(ABC):
    """A rule by which a Kalman-type observer tests the innovations of its sensors."""

    #: Samples in a row after which a sensor that fails is due.
    reopen: int

    #: Whether sensors that fail are rejected.
    rejects: bool

    @abstractmethod
    def sensors(self, outputs: int) -> tuple[tuple[int, ...], ...]:
        """The outputs of each sensor, for this number of outputs."""

    @abstractmethod
    def limits(self, outputs: int) -> Array:
        """The largest squared innovations of sensors with 1, 2, ... outputs that are there."""

    @property
    def c_name(self) -> str | None:
        """NAME of ``codegen/c/innovation_NAME.c``, by which C applies the tests; None if it cannot.

        That part has two functions: ``mhe_apply_tests``, by which outputs count less or not at all,
        and ``mhe_rejection``, the bits of a status. All rules have the same tests.
        """
        return None

    def c_data(self, outputs: int) -> dict[str, NDArray[Any]]:
        """The numbers of the tests, ``settings->innovation`` in C."""
        limits, of_output = np.zeros(outputs), np.zeros(outputs, np.int32)
        given = self.limits(outputs)
        limits[: given.size] = given
        for k, sensor in enumerate(self.sensors(outputs)):
            of_output[list(sensor)] = k
        return {"limits": limits, "sensor_of": of_output, "reopen": np.array(self.reopen, np.int32)}

    @abstractmethod
    def judge(
        self, prediction: Prediction, noise: Array, v: Array, observed: Mask, rejections: Counts
    ) -> Verdict:
        """Judge a sample.

        Parameters
        ----------
        prediction : Prediction
            Of the outputs that are there.
        noise, v : (q, q) and (q,) array
            Covariance of their noise, and their innovations.
        observed : (p,) bool array
            Which outputs are there.
        rejections : (s,) int array
            Consecutive failures of each sensor before this sample.
        """

    def _judged(
        self, prediction: Prediction, noise: Array, v: Array, observed: Mask, rejections: Counts
    ) -> _Judged:
        """Test each sensor, and find those that are due and how P would have to grow for each."""
        parts, limits, least = self._parts(observed)
        innovation, covariance = prediction.spread + noise, prediction.covariance
        passes = np.array([
            not part
            or prediction.distance(innovation, covariance, noise, v, [], part) <= limit
            for part, limit in zip(parts, limits, strict=True)
        ])
        counts = np.where(passes, 0, rejections + 1)
        for k, part in enumerate(parts):
            if not part:
                counts[k] = rejections[k]
        late = np.flatnonzero((rejections >= self.reopen) & ~passes).tolist()
        due: dict[int, Array] = {}
        # Those that were contradicted wait.
        if late and not (self.rejects and all(rejections[k] % self.reopen for k in late)):
            known = [place for k in np.flatnonzero(passes) for place in parts[k]]
            if sum(len(parts[k]) for k in late) > len(known):
                known = []
            for k in late:
                given = known if rejections[k] < LONGEST * self.reopen else []
                growth = self._growth(prediction, noise, v, parts[k], given, limits[k], least)
                if growth is not None:
                    due[k] = growth
        return _Judged(parts, passes, counts, due)

    def _growth(
        self, prediction: Prediction, noise: Array, v: Array, part: list[int], given: list[int],
        limit: float, least: float,
    ) -> Array | None:
        """Factors (n,) of the variances with which a sensor passes; None if there are none."""
        shares, factor = prediction.shares(part, noise), 1.0

        def innovation(factor: float) -> tuple[Array, Array]:
            larger = prediction.grown(1.0 + (factor - 1.0) * shares)
            return prediction.spread_of(larger) + noise, larger

        for _ in range(MOST_GROWTH):
            factor *= GROWTH
            variances = innovation(factor)[0].diagonal()[part]
            if (v[part] ** 2 <= least * variances).all():
                break
        else:
            return None
        factor *= GROWTH
        if not prediction.distance(*innovation(factor), noise, v, given, part) <= limit:
            return None
        growth: Array = 1.0 + ((factor if self.rejects else GROWTH) - 1.0) * shares
        return growth

    def _parts(self, observed: Mask) -> tuple[list[list[int]], Array, float]:
        """Places of each sensor's outputs that are there, their limits, and that of one output."""
        key = observed.tobytes()
        known: dict[bytes, Any] = self.__dict__.setdefault("_known", {})
        if key not in known:
            if len(known) > 256:
                known.clear()
            places = (np.cumsum(observed) - 1).tolist()
            parts = [
                [places[output] for output in sensor if observed[output]]
                for sensor in self.sensors(observed.size)
            ]
            table = np.append(self.limits(observed.size), 0.0)
            limits = np.array([table[len(part) - 1] for part in parts])
            known[key] = parts, limits, float(table[0])
        found: tuple[list[list[int]], Array, float] = known[key]
        return found


class _Judged(NamedTuple):
    """The places, results and counts of all sensors, and growths of P for those that are due."""

    parts: list[list[int]]
    passes: Mask
    counts: Counts
    due: dict[int, Array]

    def larger(self, prediction: Prediction) -> Array | None:
        """P, grown for all that are due."""
        return prediction.grown(np.max(list(self.due.values()), axis=0)) if self.due else None


@dataclass(frozen=True)
class Gate(Innovation):
    r"""A chi-square gate for each sensor, which reopens after it has been shut for too long.

    A sensor s is one output, or one of the groups. With its rows C of the Jacobian of h, its
    innovation is tested against its covariance:

    .. math::
        v_s^\top S_{ss}^{-1} v_s \le \chi^2_{p_s}(\text{probability}), \qquad
        S = C P C^\top + R

    with :math:`p_s` its number of available outputs. A sensor that fails is rejected: the observer
    corrects, and propagates its covariance, as if its outputs were missing.

    A gate can reject correct measurements if P is too small for the observer's error. A sensor that
    has been rejected ``reopen`` times in a row and fails once more is therefore due: P becomes
    :math:`T P T` with

    .. math::
        T_{ii}^2 = 1 + (4^{k+1} - 1) \frac{r_i}{\max_j r_j}, \qquad
        r_i = \frac{(P C_s^\top S_{ss}^{-1} C_s P)_{ii}}{P_{ii}}

    and the smallest k from 1 to 20 for which, with :math:`4^k` in place of :math:`4^{k+1}`, each of
    its outputs would pass alone. :math:`r_i` is the share by which the sensor would reduce the
    variance of :math:`x_i`: the variances of the states that it shows grow, correlations stay. The
    sensor opens if, with this P, its innovation passes given the innovations of the sensors that
    passed before. The observer then also corrects with it, and its count restarts; if several open
    at once, each :math:`T_{ii}` is their largest. So the covariance explains the innovations used,
    and the gain is near one along them.

    Otherwise the passing sensors contradict it, and it stays rejected for another ``reopen``
    samples. So a sensor with a lasting fault stays shut if others measure the same, and is followed
    if it alone does. The others may be wrong instead: they are ignored if they have fewer outputs
    than the sensors rejected that often, and for a sensor rejected 10 ``reopen`` times in a row,
    which then opens at the latest. When one sensor is due, so are all that were rejected ``reopen``
    times. A sensor stays shut if no k makes it pass: P does not span what it measures, or its
    outputs contradict each other. Samples in which a sensor is missing do not count.

    Parameters
    ----------
    probability : float
        Probability that a sensor without fault passes, above 0 and below 1.
    reopen : int
        Consecutive rejections after which a sensor reopens, at least 1.
    groups : sequence of sequences of int, optional
        Outputs that form one sensor, such as the components of a position; each output in at most
        one group. Every other output is a sensor by itself. Sensors are ordered by their first
        outputs.

    Raises
    ------
    OptionError
        If a value is out of range, or an output is in two groups or not one of the system's.

    References
    ----------
    Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001,
    sections 3.7 (gating) and 5.4 (normalised innovation squared).
    """

    probability: float = 0.997
    reopen: int = 10
    groups: Sequence[Sequence[int]] | None = None

    rejects = True

    def __post_init__(self) -> None:
        probability = finite(self.probability)
        if probability is None or not 0.0 < probability < 1.0:
            raise OptionError(
                f"probability is {shown(self.probability)}; expected a number above 0 and "
                "below 1, such as 0.997."
            )
        object.__setattr__(self, "probability", probability)
        object.__setattr__(self, "reopen", _checked_reopen(self.reopen))
        object.__setattr__(self, "groups", _checked_groups(self.groups))

    def sensors(self, outputs: int) -> tuple[tuple[int, ...], ...]:
        """The groups and the other outputs, by their first outputs."""
        groups = tuple(tuple(group) for group in self.groups or ())
        taken = {output for group in groups for output in group}
        if taken and max(taken) >= outputs:
            raise OptionError(
                f"groups has the output {max(taken)}; expected outputs from 0 to {outputs - 1}."
            )
        alone = ((output,) for output in range(outputs) if output not in taken)
        return tuple(sorted((*groups, *alone), key=min))

    def limits(self, outputs: int) -> Array:
        """Quantiles of the chi-square distributions; see `Innovation.limits`."""
        from scipy.special import gammaincinv  # late: most programs do without

        most = max(map(len, self.sensors(outputs)))
        return np.asarray(2.0 * gammaincinv(0.5 * np.arange(1, most + 1), self.probability))

    @property
    def c_name(self) -> str | None:
        """The gate in C, unless a derived class may judge otherwise."""
        return "gate" if type(self) is Gate else None

    def judge(
        self, prediction: Prediction, noise: Array, v: Array, observed: Mask, rejections: Counts
    ) -> Verdict:
        """Test each sensor, and open those that are due; see `Innovation.judge`."""
        found = self._judged(prediction, noise, v, observed, rejections)
        passes, counts, opened = found.passes, found.counts, list(found.due)
        passes[opened], counts[opened] = True, 0
        kept = np.ones(v.size, np.bool_)
        for part, passed in zip(found.parts, passes, strict=True):
            kept[part] = passed
        larger = found.larger(prediction)
        return Verdict(larger, None if kept.all() else kept, None, counts)


@dataclass(frozen=True)
class HuberInnovation(Innovation):
    r"""Weight innovations beyond a threshold less, as in Huber's M-estimate.

    Each output's innovation, in its standard deviation, gets Huber's weight:

    .. math::
        \nu_j = v_j / \sqrt{S_{jj}}, \qquad
        \omega_j = \min(1, c / |\nu_j|), \qquad S = C P C^\top + R

    The observer then corrects with the noise covariance :math:`\tilde R = R +
    \operatorname{diag}(S_{jj} (1 / \omega_j - 1))`, so that the variance of an innovation is
    :math:`S_{jj} / \omega_j`. With one output this is the correction :math:`K \omega v` with the
    covariance :math:`P - \omega P C^\top S^{-1} C P` after it: an outlier corrects by no more than
    an innovation of c standard deviations, and the covariance decreases accordingly less.

    This alone would correct an observer with too small a covariance by at most c standard
    deviations per sample. Once an output has been beyond the threshold ``reopen`` times in a row, P
    therefore grows before each further such sample, as in `Gate` with k = 0: standard deviations at
    most double per sample, so that the model is relinearised often on the way. As there, P does not
    grow while the outputs within the threshold contradict this.

    Parameters
    ----------
    threshold : float
        c, dimensionless, above 0. 1.345 has 95 % of the efficiency of least squares with Gaussian
        noise.
    reopen : int
        Consecutive samples beyond the threshold after which P grows, at least 1.

    Raises
    ------
    OptionError
        If the threshold is not positive, or ``reopen`` is not an integer above 0.

    References
    ----------
    Huber, Robust Statistics, 1981, chapter 7. Karlgaard and Schaub, Huber-based divided difference
    filtering, Journal of Guidance, Control, and Dynamics 30 (2007).
    """

    threshold: float = 1.345
    reopen: int = 10

    rejects = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "threshold", positive("threshold", self.threshold))
        object.__setattr__(self, "reopen", _checked_reopen(self.reopen))

    def sensors(self, outputs: int) -> tuple[tuple[int, ...], ...]:
        """Each of the outputs alone."""
        return tuple((output,) for output in range(outputs))

    def limits(self, outputs: int) -> Array:
        """The threshold's square; see `Innovation.limits`."""
        return np.array([self.threshold**2])

    @property
    def c_name(self) -> str | None:
        """The weights in C, unless a derived class may judge otherwise."""
        return "huber" if type(self) is HuberInnovation else None

    def judge(
        self, prediction: Prediction, noise: Array, v: Array, observed: Mask, rejections: Counts
    ) -> Verdict:
        """Weigh each output; see `Innovation.judge`."""
        found = self._judged(prediction, noise, v, observed, rejections)
        larger = found.larger(prediction)
        spread = prediction.spread if larger is None else prediction.spread_of(larger)
        variances = (spread + noise).diagonal()
        excess = np.abs(v) / np.sqrt(variances) / self.threshold - 1.0
        return Verdict(
            larger, None, noise + np.diag(variances * np.maximum(excess, 0.0)), found.counts
        )


def _checked_reopen(reopen: Any) -> int:
    return count("reopen", reopen, 1, most=2**31 - 2)


def _checked_groups(groups: Any) -> tuple[tuple[int, ...], ...] | None:
    if groups is None:
        return None
    try:
        given = [list(group) for group in groups]
    except TypeError as error:
        raise OptionError(
            f"groups is {shown(groups)}; expected lists of outputs, such as [[0, 1], [2, 3]]."
        ) from error
    checked = [[integer(output) for output in group] for group in given]
    flat = [output for group in checked for output in group]
    if not all(checked) or any(output is None or output < 0 for output in flat):
        raise OptionError(
            f"groups is {shown(groups)}; expected lists of outputs, integers >= 0."
        )
    if len(set(flat)) < len(flat):
        raise OptionError(f"groups is {shown(groups)}; expected each output in one group at most.")
    return tuple(tuple(output for output in group if output is not None) for group in checked)
