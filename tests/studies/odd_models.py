"""Models that go wrong in the record of seed 1; everything else is the batch reactor."""

import ctypes
import os
from collections.abc import Callable
from dataclasses import fields
from functools import partial

from qpmhe.models import Example, Record, Scenario, batch_reactor


class OddScenario(Scenario):
    action: Callable[[], object]

    def simulate(self, seed: int, steps: int | None = None) -> Record:
        if seed == 1:
            self.action()
        return super().simulate(seed, steps)


def _odd(action: Callable[[], object]) -> Example:
    parts = batch_reactor()
    values = {item.name: getattr(parts.scenario, item.name) for item in fields(Scenario)}
    scenario = OddScenario(**values)
    object.__setattr__(scenario, "action", action)
    return parts._replace(scenario=scenario)


raises = partial(_odd, lambda: 1 / 0)
leaves = partial(_odd, lambda: exit(3))
crashes = partial(_odd, lambda: ctypes.string_at(0))
is_killed = partial(_odd, lambda: os.kill(os.getpid(), 9))
# PyDLL keeps the interpreter's lock: no thread of Python's gets a turn.
hangs = partial(_odd, lambda: ctypes.PyDLL(None).sleep(100))


def cannot_be_made() -> Example:
    raise RuntimeError("no such reactor")


def three_parts() -> tuple[object, ...]:
    return batch_reactor()[:3]
