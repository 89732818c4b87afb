"""Suboptimal moving horizon estimation by sequences of convex QPs, with a stability promise."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from . import batch, codegen, errors, models, solvers
from ._version import __version__
from .adapters.casadi import from_casadi
from .adapters.control import from_control
from .adapters.fmu import from_fmu
from .adapters.iosystem import to_iosystem
from .adapters.jax import from_jax
from .adapters.learnt import from_onnx, from_sklearn, from_torch
from .adapters.sympy import from_sympy
from .batch import BatchEstimator
from .codegen import Compiled, compile
from .codegen.compiler import check_any_cached
from .codegen.payoff import prepare
from .codegen.source import MAIN
from .costs import (
    Barron,
    Cauchy,
    Cost,
    CostConstants,
    GemanMcClure,
    Huber,
    Loss,
    ObserverPrior,
    Power,
    Quadratic,
    QuadraticCost,
    RobustCost,
)
from .errors import ModelWarning, ObserverWarning, PriorWarning, QpmheError
from .estimation.engines import Engine, register_engine
from .estimation.estimate import DroppedRow, Estimate, Status
from .estimation.estimator import MovingHorizonEstimator
from .estimation.run import Run
from .estimation.settings import Settings
from .model.coloured_noise import ColouredNoise, augment_noise
from .model.constraint import Constraint
from .model.noisy_inputs import noisy_inputs
from .model.parameters import augment_parameters
from .model.residuals import angles
from .model.sets import Box, ConvexSet, Polytope, SoftSet
from .model.system import System
from .observers import (
    ExtendedKalman,
    Gate,
    HighGain,
    HuberInnovation,
    Luenberger,
    Observer,
    OutputInjection,
    Sample,
    SteadyStateKalman,
    UnscentedKalman,
    design_luenberger,
)
from .sensitivity import ActiveRow, Gradient, Sensitivity

if TYPE_CHECKING:
    from . import baselines, certificates, diagnosis, plots, records, studies, tuning
    from .diagnosis import diagnose
    from .tuning import tune


def _compiled_engine(
    system: System, observer: Observer, cost: Cost, settings: Settings, initial_state: Any
) -> Engine:
    if settings.engine == "auto":
        check_any_cached(MAIN)
    from .codegen.rehearsal import compiled_engine  # late: most programs do without

    return compiled_engine(system, observer, cost, settings, initial_state)


register_engine("compiled", _compiled_engine, prepare)
MovingHorizonEstimator.differentiate = Sensitivity


def _page(run: Run) -> str:
    """The run as HTML."""
    from .plots.page import run_page  # late: it needs Matplotlib

    return run_page(run)


Run.page = staticmethod(_page)
load_run = Run.load


# What most programs do without is imported when it is first named.
_LATE_MODULES = ("baselines", "certificates", "diagnosis", "plots", "records", "studies", "tuning")
_LATE_FUNCTIONS = {"diagnose": "diagnosis", "tune": "tuning"}


def __getattr__(name: str) -> Any:
    if name in _LATE_MODULES:
        return import_module(f"{__name__}.{name}")
    if name in _LATE_FUNCTIONS:
        value = getattr(import_module(f"{__name__}.{_LATE_FUNCTIONS[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


__all__ = [
    "ActiveRow",
    "Barron",
    "BatchEstimator",
    "Box",
    "Cauchy",
    "ColouredNoise",
    "Compiled",
    "Constraint",
    "ConvexSet",
    "Cost",
    "CostConstants",
    "DroppedRow",
    "Estimate",
    "ExtendedKalman",
    "Gate",
    "GemanMcClure",
    "Gradient",
    "HighGain",
    "Huber",
    "HuberInnovation",
    "Loss",
    "Luenberger",
    "ModelWarning",
    "MovingHorizonEstimator",
    "Observer",
    "ObserverPrior",
    "ObserverWarning",
    "OutputInjection",
    "Polytope",
    "Power",
    "PriorWarning",
    "QpmheError",
    "Quadratic",
    "QuadraticCost",
    "RobustCost",
    "Run",
    "Sample",
    "Sensitivity",
    "SoftSet",
    "Status",
    "SteadyStateKalman",
    "System",
    "UnscentedKalman",
    "__version__",
    "angles",
    "augment_noise",
    "augment_parameters",
    "baselines",
    "batch",
    "certificates",
    "codegen",
    "compile",
    "design_luenberger",
    "diagnose",
    "diagnosis",
    "errors",
    "from_casadi",
    "from_control",
    "from_fmu",
    "from_jax",
    "from_onnx",
    "from_sklearn",
    "from_sympy",
    "from_torch",
    "load_run",
    "models",
    "noisy_inputs",
    "plots",
    "records",
    "solvers",
    "studies",
    "to_iosystem",
    "tune",
    "tuning",
]
