"""The QP backends, as `qpmhe.solvers`: the public names of the package ``qpmhe_solvers``."""

import qpmhe_solvers
from qpmhe_solvers import *  # noqa: F403 - these are all its names

__all__ = []
__all__ += qpmhe_solvers.__all__
