"""Which of the certificate's hypotheses held, at one step and along a run."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

__all__ = ["NEEDED", "UNNEEDED", "Hypotheses", "MonitorSummary"]


@dataclass(frozen=True)
class Hypotheses:
    """Which hypotheses held at one step; each is checked anew from the estimate's numbers.

    Parameters
    ----------
    cost_decrease : bool
        (eq:estimator): the estimate costs no more than the candidate, and the costs told are
        those of the trajectories (which is checked where the window is complete).
    complete : bool
        All measurements of the window are there, and the model could be evaluated.
    observer_candidate : bool
        (eq:warmstart): the candidate is the observer's trajectory, not a projection of it,
        and corrects by the certificate's gain, where that is constant.
    kappa : bool
        (eq:kappa): |L| <= kappa |v_z| all along the candidate.
    candidate_in_region, estimate_in_region : bool
        All states of the window but the newest lie in the certified set, and so do the
        inputs. The newest one need not: nothing is concluded from it yet.
    candidate_in_sets : bool
        Assumption ass:observer: the candidate's states, corrections and fitting errors are in
        X, W and V.
    feasible : bool
        (eq:constraints): the estimate's states, disturbances and noises are in X, W and V.
    """

    cost_decrease: bool
    complete: bool
    observer_candidate: bool
    kappa: bool
    candidate_in_region: bool
    estimate_in_region: bool
    candidate_in_sets: bool
    feasible: bool

    @property
    def held(self) -> bool:
        """Whether the certificate's bound follows at this step, if it did at those before.

        The last two are no part of that: what is certified holds for any w and v, so that
        the theorem may be applied with the whole space in place of W and V, and with the
        region in place of X, which is the paper's remedy after Assumption ass:observer.
        """
        return not self.failed

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of those that the bound needs and that did not hold."""
        return tuple(name for name in NEEDED if not getattr(self, name))


#: The hypotheses that are told only, and those that the bound needs.
UNNEEDED = ("candidate_in_sets", "feasible")
NEEDED = tuple(each.name for each in fields(Hypotheses) if each.name not in UNNEEDED)


@dataclass(frozen=True)
class MonitorSummary:
    """For how many steps of a run the certificate applied.

    Parameters
    ----------
    steps : int
        Steps of the run.
    applied : int
        Steps from the first on, until the first at which a needed hypothesis did not hold:
        the observer's bound goes back to the start, and is lost with it.
    held : int
        Steps at which all needed hypotheses held, whatever had happened before.
    counts : dict of str to int
        At how many steps each hypothesis held.
    first_failure : int or None
        The first step at which one did not.
    failed : tuple of str
        Which ones, then.
    """

    steps: int
    applied: int
    held: int
    counts: dict[str, int]
    first_failure: int | None
    failed: tuple[str, ...]

    @property
    def missed(self) -> dict[str, int]:
        """At how many steps each hypothesis did not hold."""
        return {name: self.steps - self.counts.get(name, 0) for name in (*NEEDED, *UNNEEDED)}

    def to_dict(self) -> dict[str, Any]:
        """Everything in types that JSON knows."""
        return {
            "steps": self.steps, "applied": self.applied, "held": self.held,
            "first_failure": self.first_failure, "failed": list(self.failed),
            "hypotheses": {
                name: {"needed": name in NEEDED, "failed": count, "held": self.steps - count}
                for name, count in self.missed.items()
            },
        }

    def __str__(self) -> str:
        told = f"The certificate applied at {self.applied} of {self.steps} steps"
        if self.first_failure is None:
            told += "."
        else:
            reasons = ", ".join(_words(name) for name in self.failed)
            told += (
                f": at step {self.first_failure} it was lost ({reasons} did not hold). All "
                f"hypotheses that the bound needs held at {self.held} steps."
            )
            told += _counted("Not held", {name: self.missed[name] for name in NEEDED})
        return told + _counted(
            "Not held either, but the bound needs no sets" if self.failed
            else "Not held, but the bound needs no sets",
            {name: self.missed[name] for name in UNNEEDED},
        )


def _words(name: str) -> str:
    return name.replace("_", " ")


def _counted(what: str, missed: dict[str, int]) -> str:
    """A sentence about the hypotheses that did not hold at all steps; empty without any."""
    told = ", ".join(
        f"{_words(name)} at {count} step{'s' if count > 1 else ''}"
        for name, count in missed.items() if count
    )
    return f" {what}: {told}." if told else ""
