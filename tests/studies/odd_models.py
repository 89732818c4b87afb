"""Models that go wrong in the record of seed 1; everything else is the batch reactor."""

import ctypes
import os
from collections.abc import Callable
from dataclasses import fields

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


def raises() -> Example:
    return _odd(lambda: 1 / 0)


def leaves() -> Example:
    return _odd(lambda: exit(3))


def crashes() -> Example:
    return _odd(lambda: ctypes.string_at(0))


def is_killed() -> Example:
    return _odd(lambda: os.kill(os.getpid(), 9))


def hangs() -> Example:
    # PyDLL keeps the interpreter's lock: no thread of Python's gets a turn.
    return _odd(lambda: ctypes.PyDLL(None).sleep(100))


def cannot_be_made() -> Example:
    raise RuntimeError("no such reactor")


def three_parts() -> tuple[object, ...]:
    return batch_reactor()[:3]


def wrong_part() -> tuple[object, ...]:
    system, observer, _, scenario = batch_reactor()
    return system, observer, "cost", scenario


not_callable = 3
