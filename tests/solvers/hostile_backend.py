"""Backends that crash, hang, print and leave, in a module that another process can import."""

import os
import signal
import time

import numpy as np

from qpmhe_solvers import Backend, RawSolution, Solver


class Hostile(Solver):
    """Does what the first entry of the gradient says; the sign alone survives the scaling."""

    count = 0

    def misbehave(self, qp):
        pass

    def _solve(self, qp, start):
        if qp.gradient[0, 0] > 0.0:
            self.misbehave(qp)
        self.count += 1
        return RawSolution(-qp.gradient / qp.band[:, :, 0], True, self.count, np.zeros(qp.size))

    def prepare(self, size):
        self.count = 1000 * size

    def forget(self):
        self.count = 0

    def shift(self):
        self.count += 100


class Crashing(Hostile):
    def misbehave(self, qp):
        os.kill(os.getpid(), signal.SIGSEGV)


class CrashingOnce(Hostile):
    """At the only window of six states, while it grows."""

    def _solve(self, qp, start):
        if qp.stages == 6:
            os.kill(os.getpid(), signal.SIGSEGV)
        return super()._solve(qp, start)


class Hanging(Hostile):
    def misbehave(self, qp):
        time.sleep(60.0)


class Printing(Hostile):
    def misbehave(self, qp):
        os.write(1, b"words of a solver\n")


class Overriding(Hostile):
    def solve(self, qp, start=None):
        if qp.gradient[0, 0] > 0.0:
            return 3
        raise ValueError("what it says")


class Unmakeable(Hostile):
    def __init__(self, options):
        raise RuntimeError("no licence")


def entry(kind):
    return Backend(kind.__name__.lower(), kind, "theatre")
