"""Whether compiling is earned back within one record, decided before its first sample.

Both sides are estimated from sizes and not by a clock, so that a record is run by the same engine
each time. The numbers were fitted to the processor's time of 24 estimators on one machine: models
of the zoo, chains of masses with 6 to 48 states and dense networks with 6 to 40, with no QP, one,
two and all. Other machines and compilers change the ratio less than they change the times.
"""

from __future__ import annotations

import math
from dataclasses import replace

from ..costs import Cost
from ..estimation.settings import Settings
from ..model.system import System
from ..observers import Observer
from .compiler import NotCachedError, required_compiler

#: Seconds for which a run waits for the compiler.
PATIENCE = 60.0
# Looking into the cache takes as long as a hundred samples: a share of the shortest that pays.
_LOOK = 0.1


def samples_that_pay(system: System, observer: Observer, settings: Settings) -> int:
    """From how many samples on compiling is earned back, for a system that has C code."""
    model, n = system.symbolic, system.n
    has_rows = bool(system.extensions) or any(
        one is not None for one in (system.states, system.disturbances, system.noises)
    )
    is_filter = observer.constant_gain is None
    operations: int = model.f.n_instructions() + model.h.n_instructions()
    # Loops over few states are compiled in no time; n does not matter from a dozen on.
    seconds = 3.2 - 4.0 / max(n, 2) + operations / 2500.0 + is_filter + has_rows
    saved = 130e-6 + settings.horizon * n**2 * 1e-6 / 30.0
    # The first QP has all that the candidate has; how many there are to convergence, nobody knows.
    qps = settings.max_qps
    saved *= 2.5 if qps is None else min(0.3 + 0.7 * qps, 0.6 + 0.4 * qps, 2.5)
    # Those of filters by their covariances; those of inequalities, where a few samples have
    # active ones, each of which takes Python as long as ten to twenty without.
    saved += is_filter * (60e-6 + 2e-6 * n**2) + has_rows * 350e-6
    return 100 * math.ceil(float(seconds / saved) / 100.0)


def prepare(
    system: System, observer: Observer, cost: Cost, settings: Settings, samples: int
) -> tuple[bool, str]:
    """Have the library in the cache where that pays; whether it is there, and why."""
    if system.symbolic is None:
        return False, ""
    try:
        needed = samples_that_pay(system, observer, settings)
        if samples < _LOOK * needed:
            return False, ""
        from .library import uncovered  # late: most programs do without
        from .rehearsal import checked_library

        if reason := uncovered(system, observer, cost, settings):
            return False, reason
        required_compiler()
        pays = f"compiling pays from about {needed:,} samples on, and these are {samples:,}"
        try:
            checked_library(system, observer, cost, settings)
            return True, "its library is in the cache"
        except NotCachedError:
            if samples < needed:
                return False, pays
        wanted = replace(settings, engine="compiled")
        checked_library(system, observer, cost, wanted, PATIENCE)
        return True, pays
    except Exception as error:  # of an engine that nobody asked for: the Python step runs
        return False, (str(error).splitlines() or [type(error).__name__])[0]
