"""What a Kalman-type observer makes of innovations that its covariance does not explain."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.values import finite, integer, shown

from .._checks import Array, count, positive
from .._linalg import unit_diagonal
from ..errors import OptionError

Mask = NDArray[np.bool_]
Counts = NDArray[np.int64]

#: The covariance grows by a power of this factor, and by at most the one with this exponent: beyond
#: it, the covariance of the noise would be lost in rounding.
GROWTH, MOST_GROWTH = 4.0, 20


class Verdict(NamedTuple):
    """What an observer corrects by.

    Parameters
    ----------
    growth : float
        Factor of the covariance P.
    kept : (q,) bool array or None
        Which of the outputs that are there correct; None for all.
    noise : (q, q) array
        Covariance of the noise of all outputs that are there.
    rejections : (s,) int array or None
        Rejections in a row of each sensor, this sample included; None without a gate.
    """

    growth: float
    kept: Mask | None
    noise: Array
    rejections: Counts | None


class Innovation(ABC):
    """A rule by which a Kalman-type observer judges its innovations."""

    @abstractmethod
    def sensors(self, outputs: int) -> tuple[tuple[int, ...], ...]:
        """The outputs of each sensor whose rejections are counted, of so many outputs."""

    @abstractmethod
    def judge(
        self, spread: Array, noise: Array, v: Array, observed: Mask, rejections: Counts
    ) -> Verdict:
        """Judge a sample.

        Parameters
        ----------
        spread, noise : (q, q) array
            :math:`C P C'` and R of the outputs that are there.
        v : (q,) array
            Their innovations.
        observed : (p,) bool array
            Which outputs are there.
        rejections : (s,) int array
            Rejections in a row of each sensor before this sample.
        """


@dataclass(frozen=True)
class Gate(Innovation):
    r"""A chi-square gate for each sensor, which opens again when it has shut for too long.

    A sensor s is one output, or one of the groups. With the rows C of the Jacobian of h, its
    innovation is tested in its own covariance:

    .. math::
        v_s^\top S_{ss}^{-1} v_s \le \chi^2_{p_s}(\text{probability}), \qquad
        S = C P C^\top + R

    with :math:`p_s` its outputs that are there. A sensor that fails is rejected: the observer
    corrects, and its covariance proceeds, as if its outputs were missing.

    A gate can shut on the truth, where P is too small for the observer's error. A sensor that has
    been rejected ``reopen`` times in a row and fails once more is therefore due to open: P is
    multiplied by the least power of 4 with which its innovation passes, given those of the sensors
    that passed; with several due, the least that opens all of them. The observer corrects with this
    P, by the sensors that passed and those that opened, and counts their rejections anew. So the
    covariance explains what the observer corrects by, and the gain is near one along it; all of P
    grows, as a covariance that is false in one direction is not to be trusted in the others.

    A sensor stays rejected, and due, while no power up to :math:`4^{20}` makes it pass: the
    sensors that pass contradict it, however wrong P is, or P spans nothing of what it sees. So a
    sensor with a lasting fault stays shut where others show the same, and is followed where it
    alone does. Samples in which a sensor is missing do not count.

    Parameters
    ----------
    probability : float
        Probability with which a sensor without fault passes, above 0 and below 1.
    reopen : int
        Rejections in a row after which a sensor opens, at least 1.
    groups : sequence of sequences of int, optional
        Outputs that are one sensor, as the components of a position; each output in at most one
        group. The others are sensors of their own, and sensors are in the order of their first
        outputs.

    Raises
    ------
    OptionError
        If a value is out of its range, or an output is in two groups or not one of the system's.

    References
    ----------
    Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001,
    section 3.7 (gating) and 5.4 (normalised innovation squared).
    """

    probability: float = 0.997
    reopen: int = 10
    groups: Sequence[Sequence[int]] | None = None

    def __post_init__(self) -> None:
        probability = finite(self.probability)
        if probability is None or not 0.0 < probability < 1.0:
            raise OptionError(
                f"probability is {shown(self.probability)}; expected a number above 0 and below 1, "
                "as 0.997."
            )
        object.__setattr__(self, "probability", probability)
        object.__setattr__(self, "reopen", count("reopen", self.reopen, 1, most=2**31 - 2))
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

    def thresholds(self, outputs: int) -> Array:
        """The thresholds of sensors with 1, 2, ... outputs, up to the largest sensor's."""
        from scipy.special import gammaincinv  # late: most programs do without

        most = max(map(len, self.sensors(outputs)))
        return np.asarray(2.0 * gammaincinv(0.5 * np.arange(1, most + 1), self.probability))

    def judge(
        self, spread: Array, noise: Array, v: Array, observed: Mask, rejections: Counts
    ) -> Verdict:
        """Test each sensor, and open those that were rejected too often; see `Innovation.judge`."""
        parts, thresholds = self._parts(observed)
        innovation = spread + noise
        passes = np.array([
            not part or _distance(innovation, v, [], part) <= most  # False for NaN, too
            for part, most in zip(parts, thresholds, strict=True)
        ])
        growth, opening = 1.0, self._due(parts, passes, rejections)
        if opening:
            known = [place for k in np.flatnonzero(passes) for place in parts[k]]

            def opens(k: int, factor: float) -> bool:
                distance = _distance(factor * spread + noise, v, known, parts[k])
                return distance <= float(thresholds[k])

            opening = [k for k in opening if opens(k, GROWTH**MOST_GROWTH)]
            while not all(opens(k, growth) for k in opening):
                growth *= GROWTH
            passes[opening] = True
        following = np.where(passes, 0, rejections + 1)
        kept = np.ones(v.size, np.bool_)
        for k, part in enumerate(parts):
            kept[part] = passes[k]
            if not part:
                following[k] = rejections[k]
        return Verdict(growth, None if kept.all() else kept, noise, following)

    def _due(self, parts: list[list[int]], passes: Mask, rejections: Counts) -> list[int]:
        """The sensors that are to open."""
        late = (rejections >= self.reopen) & ~passes
        return [k for k in np.flatnonzero(late).tolist() if parts[k]]

    def _parts(self, observed: Mask) -> tuple[list[list[int]], Array]:
        """For each sensor its places among the outputs that are there, and its threshold."""
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
            table = np.append(self.thresholds(observed.size), 0.0)
            known[key] = parts, np.array([table[len(part) - 1] for part in parts])
        found: tuple[list[list[int]], Array] = known[key]
        return found


@dataclass(frozen=True)
class HuberInnovation(Innovation):
    r"""Innovations beyond a threshold count less, as in Huber's M-estimate.

    Each output's innovation is taken in its own standard deviation, and gets Huber's weight:

    .. math::
        \nu_j = v_j / \sqrt{S_{jj}}, \qquad
        \omega_j = \min(1, c / |\nu_j|), \qquad S = C P C^\top + R

    The observer then corrects with the noise covariance
    :math:`\tilde R = R + \operatorname{diag}(S_{jj} (1 / \omega_j - 1))`, so that the variance of
    an innovation is :math:`S_{jj} / \omega_j`. With one output this is the correction
    :math:`K \omega v` and the covariance :math:`P - \omega P C^\top S^{-1} C P` behind it: an
    outlier corrects by no more than one of c standard deviations does, and the covariance says how
    little was learnt from it. Nothing is ever rejected, so there is no gate to open again; from a
    covariance that is too small the observer recovers by at most c standard deviations a sample.

    Parameters
    ----------
    threshold : float
        c, without unit, above 0. 1.345 has 95 % of the efficiency of least squares where the noise
        is Gaussian.

    Raises
    ------
    OptionError
        If the threshold is not positive.

    References
    ----------
    Huber, Robust Statistics, 1981, chapter 7. Karlgaard and Schaub, Huber-based divided difference
    filtering, Journal of Guidance, Control, and Dynamics 30 (2007).
    """

    threshold: float = 1.345

    def __post_init__(self) -> None:
        object.__setattr__(self, "threshold", positive("threshold", self.threshold))

    def sensors(self, outputs: int) -> tuple[tuple[int, ...], ...]:
        """None: nothing is rejected."""
        return ()

    def judge(
        self, spread: Array, noise: Array, v: Array, observed: Mask, rejections: Counts
    ) -> Verdict:
        """Weigh each output; see `Innovation.judge`."""
        variances = (spread + noise).diagonal()
        excess = np.abs(v) / np.sqrt(variances) / self.threshold - 1.0
        added = variances * np.maximum(excess, 0.0)
        return Verdict(1.0, None, noise + np.diag(added), rejections)


def _distance(innovation: Array, v: Array, known: list[int], part: list[int]) -> float:
    """The squared norm of a part of v in its covariance, given others; infinity if singular."""
    if not known and len(part) == 1:
        return float(v[part[0]] * v[part[0]] / innovation[part[0], part[0]])
    both = known + part
    scaled, units, whole = unit_diagonal(innovation[np.ix_(both, both)])
    try:
        root = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        return math.inf
    whitened = np.linalg.solve(root, np.ldexp(v[both], -units))[len(known) :]
    return float(np.ldexp(whitened @ whitened, -whole))


def _checked_groups(groups: Any) -> tuple[tuple[int, ...], ...] | None:
    if groups is None:
        return None
    try:
        given = [list(group) for group in groups]
    except TypeError as error:
        raise OptionError(
            f"groups is {shown(groups)}; expected lists of outputs, as [[0, 1], [2, 3]]."
        ) from error
    checked = [[integer(output) for output in group] for group in given]
    flat = [output for group in checked for output in group]
    if not all(checked) or any(output is None or output < 0 for output in flat):
        raise OptionError(
            f"groups is {shown(groups)}; expected lists of outputs, numbers from 0 on."
        )
    if len(set(flat)) < len(flat):
        raise OptionError(f"groups is {shown(groups)}; expected each output in one group at most.")
    return tuple(tuple(output for output in group if output is not None) for group in checked)
