"""The studies behind docs/how-to-choose.md, all in one store."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qpmhe.models import catalogue
from qpmhe.studies import Study

HERE = Path(__file__).parent
MODELS = tuple(catalogue())
HORIZONS = (2, 5, 10, 20, 40)
#: Initial errors, in units of the zoo's.
DISTANCES = {"good": 0.1, "the zoo's": 1.0, "poor": 3.0}
OBSERVED = ("batch_reactor", "van_der_pol", "cstr", "vehicle")
OBSERVERS = {
    "own": "the zoo's", "constant": "`design_luenberger`", "steady": "`SteadyStateKalman`",
    "extended": "`ExtendedKalman`", "unscented": "`UnscentedKalman`",
}
OUTLYING = ("batch_reactor", "van_der_pol", "vehicle")
BOUNDED = ("cstr", "battery_cell")
ONE_SIDED = ("batch_reactor", "van_der_pol")
PRIORS = ("constant", "observer")


def named(function: str, model: str, **arguments: Any) -> str:
    """How a study, and its store, name a model of choice_models.py."""
    given = "".join(f", {key}={value!r}" for key, value in arguments.items())
    return f"choice_models.py:{function}(model={model!r}{given})"


def observed(model: str, kind: str, distance: float = 1.0) -> str:
    """A model with an observer, and the prior weight that goes with it."""
    prior = "constant" if kind in ("own", "constant") else "observer"
    return named("observed", model, observer=kind, prior=prior, distance=distance)


def weighed(model: str, prior: str) -> str:
    """A model with an extended Kalman filter and a prior weight."""
    return named("observed", model, observer="extended", prior=prior, distance=1.0)


def studies(
    seeds: int = 20, steps: int | None = None, models: tuple[str, ...] = MODELS
) -> dict[str, Study]:
    """The studies by name.

    Parameters
    ----------
    seeds : int
        Records of each model.
    steps : int, optional
        Samples of a record; the scenario's if left out.
    models : tuple of str
        Those of the zoo that take part.
    """

    def study(names: list[str], **options: Any) -> Study:
        common = {
            "backends": ["auto"], "solver_iterations": [None], "seeds": seeds, "steps": steps,
            "cell_timeout": 120.0,
        }
        return Study(folder=HERE, models=names, **{**common, **options})

    def of(chosen: tuple[str, ...]) -> list[str]:
        return [model for model in models if model in chosen]

    return {
        "caps": study(of(MODELS), qps=[0, 1, 2, 5, None]),
        "starts": study(of(MODELS), qps=[1], starts=["best"]),
        "horizons": study(of(MODELS), qps=[1, None], horizons=HORIZONS, measure="time"),
        "priors": study(
            [weighed(model, prior) for model in of(MODELS) for prior in PRIORS],
            qps=[2], horizons=HORIZONS, measure="time",
        ),
        "observers": study(
            [
                *(observed(model, "extended") for model in of(MODELS)),
                *(
                    observed(model, kind, distance) for model in of(OBSERVED)
                    for kind in OBSERVERS for distance in DISTANCES.values()
                ),
                *(named("without_states", model) for model in of(BOUNDED)),
                *(
                    named("one_sided", model, known=known) for model in of(ONE_SIDED)
                    for known in (False, True)
                ),
                *(
                    named("outlying", model, loss="quadratic", observer="extended")
                    for model in of(OUTLYING)
                ),
            ],
            qps=[0, 1, 2], measure="time",
        ),
        "outliers": study(
            [
                named("outlying", model, loss=loss, observer="own")
                for model in of(OUTLYING) for loss in ("quadratic", "huber")
            ],
            qps=[0, 1, 2, 5, None], measure="time",
        ),
    }
