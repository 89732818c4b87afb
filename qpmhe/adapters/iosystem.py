"""An estimator as a python-control block."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .._checks import need, positive
from ..errors import InvalidInputError, OptionError
from ..estimation.estimator import MovingHorizonEstimator

if TYPE_CHECKING:
    import control

Array = NDArray[np.float64]
Labels = str | Sequence[str]


def to_iosystem(
    mhe: MovingHorizonEstimator,
    *,
    dt: float | None = None,
    name: str = "mhe",
    measurement_labels: Labels = "y[{i}]",
    control_labels: Labels = "u[{i}]",
    estimate_labels: Labels = "xhat[{i}]",
) -> control.NonlinearIOSystem:
    r"""Make a discrete-time python-control block: :math:`y(t), u(t)` in, :math:`\hat x(t)` out.

    Its state and output are :math:`\hat x(t)`, which uses the measurements before t, so the block
    has no direct feedthrough and causes no algebraic loop; the block of
    ``control.optimal.OptimalEstimationProblem.create_mhe_iosystem`` has the same index. Its initial
    state is the initial estimate.

    Parameters
    ----------
    mhe : MovingHorizonEstimator
        It keeps its window besides the block's state. The start of a simulation, or any state other
        than its current one, resets it with that state as the initial estimate. Do not use it
        elsewhere meanwhile.
    dt : float, optional
        Sampling time. The default is the system's if `System.from_ode` made it, else unspecified.
    name : str
        Name of the block.
    measurement_labels, control_labels, estimate_labels : str or sequence of str
        Names of the signals, as in ``control.create_estimator_iosystem``: one for each, or one
        with ``{i}`` for all. The defaults are python-control's, so that
        ``control.interconnect`` finds the plant's signals. A measurement that is NaN is missing;
        ``control.interconnect`` passes no NaN on.

    Returns
    -------
    control.NonlinearIOSystem
        With p + m inputs, n outputs and n states.

    Raises
    ------
    InvalidInputError
        If ``mhe`` is not an estimator, or python-control is not installed.
    OptionError
        If dt is not positive or not the system's, or the number of labels is wrong.

    Examples
    --------
    >>> import qpmhe
    >>> system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1)
    >>> cost = qpmhe.QuadraticCost(prior=1.0, disturbance=10.0, noise=1.0)
    >>> mhe = qpmhe.MovingHorizonEstimator(
    ...     system, qpmhe.Luenberger([0.3]), cost, horizon=5, initial_state=[0.0])
    >>> block = qpmhe.to_iosystem(mhe)
    >>> block.input_labels, block.output_labels
    (['y[0]'], ['xhat[0]'])
    """
    control = need("control", "to_iosystem", "control")
    if not isinstance(mhe, MovingHorizonEstimator):
        raise InvalidInputError(
            f"mhe is a {type(mhe).__name__}; expected a qpmhe.MovingHorizonEstimator."
        )
    own = mhe.system.dt
    if dt is not None and positive("dt", dt) != own is not None:
        raise OptionError(f"dt is {dt!r}, but the system has {own!r}; leave it out.")
    n, p, m = mhe.system.n, mhe.system.p, mhe.inputs
    block = _Block(mhe, p)
    return control.NonlinearIOSystem(
        block.update, block.output, name=name, dt=own or dt or True,
        inputs=[
            *_labels("measurement_labels", measurement_labels, p),
            *_labels("control_labels", control_labels, m),
        ],
        outputs=_labels("estimate_labels", estimate_labels, n),
        states=[f"{name}_{i}" for i in range(n)],
    )


class _Block:
    """The functions of the block. They may be called again at the same time, or start anew."""

    def __init__(self, mhe: MovingHorizonEstimator, p: int) -> None:
        self.mhe, self.p = mhe, p
        self.time, self.seen = np.inf, np.empty(0)

    def update(self, t: float, x: Array, signals: Array, params: dict[str, Any]) -> Array:
        seen = np.concatenate([x, signals])
        if t == self.time and np.array_equal(seen, self.seen, equal_nan=True):
            return self.mhe.state
        if t <= self.time or not np.array_equal(x, self.mhe.state):
            self.mhe.reset(x)
        self.time, self.seen = t, seen
        y, u = signals[: self.p], signals[self.p :]
        return self.mhe.update(y, u if u.size else None).state

    def output(self, t: float, x: Array, signals: Array, params: dict[str, Any]) -> Array:
        return x


def _labels(option: str, labels: Labels, many: int) -> list[str]:
    """One name for each signal."""
    given = [labels.format(i=i) for i in range(many)] if isinstance(labels, str) else labels
    found = list(given)
    if len(set(found)) != many:
        raise OptionError(
            f"{option} is {labels!r}; expected {many} different names, or one with {{i}}."
        )
    return found
