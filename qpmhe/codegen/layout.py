"""The C structures of a generated estimator, as NumPy sees them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._checks import SINGULAR
from ..costs import Cost
from ..estimation.conditions import USUAL, Conditions
from ..estimation.estimate import DroppedRow, Status
from ..estimation.limits import c_definitions
from ..estimation.window import larger
from ..memory.fields import MemorySizes
from ..model.residuals import Residual
from ..model.system import System
from ..observers import Observer
from ..observers.base import ObserverForm, covariance_of
from ..observers.roots import least_share
from ..terms.base import TermForm
from ..terms.prior import PriorWeights
from ..terms.soft import SOFT
from .compiler import has_vectors
from .directions import Directions

SET_NAMES = ("disturbances", "noises", "states")
# Terms of the cost, and their losses in the order of their numbers in C; behind these come the
# users' own, one for each term.
TERMS = ("prior", "disturbance", "noise")
LOSSES = ("quadratic", "huber", "power")

#: What mhe_set changes, in the order of its bits.
CHANGES = ("noise_weight", "disturbance_weight", *SET_NAMES)

_CLOCK_TEXT = """
 *
 * To keep time_budget, set `clock` in a copy of the settings to a function that returns seconds."""
# From so many states on, LAPACK's calls take less time than loops that a compiler made, and than
# tiles in a processor's registers; and tiles less than loops.
_LAPACK_STATES, _LAPACK_AFTER_TILES, _TILED_STATES = 40, 100, 4
# In single precision rounding makes eigenvalues of correlations of this size.
_LEAST_SINGLE = 1e-6


_SET_TYPE = Template("""typedef struct {
    mhe_real lower[$n], upper[$n], scale[$n], deviation[$n];
    mhe_real rows[$count * $n];
    mhe_real row_lower[$count], row_upper[$count], row_scale[$count], row_deviation[$count];
    uint8_t row_fixed[$count]; /* rows that are never dropped */
} mhe_${letter}_set;
""")
# Parts with numbers of their own, in words, other than terms, observer and innovation.
_PARTS = {
    "covariances": "the observer's covariances", "elimination": "directions that have disturbances",
    "quiet": "directions that have none", "restart": "the test by which an observer is restarted",
    "constraints": "the nonlinear constraints; deviations are of (x, w, v), w = through d",
}


@dataclass(frozen=True)
class Layout:
    """Sizes that are fixed when an estimator is compiled."""

    nx: int
    ny: int
    nu: int
    horizon: int
    sets: tuple[tuple[bool, int], ...]
    real: str = "double"
    #: Whether a term of the cost has a loss that is not quadratic.
    loss: bool = False
    #: Whether a loss is widened while the first window fills.
    widened: bool = False
    #: The observer's name in C, and whether its covariance is computed, and with how many rows of
    #: deviations.
    observer: str = "gain"
    covariance: bool = False
    deviations: int = 0
    constant_gain: bool = True
    needs_jacobians: bool = False
    #: The name in C of the rule that judges innovations, blank where there is none, the sensors
    #: whose innovations it judges, and whether it rejects any.
    innovation: str = ""
    sensors: int = 0
    rejects: bool = False
    #: Whether the covariance weighs the prior.
    observer_prior: bool = False
    #: Which terms have a user's loss, in the order of `TERMS`, as bits.
    own_losses: int = 0
    #: Whether the factorisation calls LAPACK, or computes with a processor's vectors.
    lapack: bool = False
    vectors: bool = False
    #: Whether there is a time budget, and a clock to keep it.
    clock: bool = False
    #: Whether a candidate outside of the sets is restored into them at a higher cost.
    restores: bool = False
    #: Whether an observer that has run away is restarted from an estimate.
    restarts: bool = False
    #: How outputs and states differ: 0 plainly, 1 by angles, 2 by functions.
    residuals: tuple[int, int] = (0, 0)
    #: Whether the set of states bounds angles.
    turns: bool = False
    #: Directions without a disturbance, and the numbers of W's rows in `DroppedRow` then.
    quiet: int = 0
    numbers: tuple[int, ...] | None = None
    #: Directions in which there are disturbances, where not all have some; else None.
    free: int | None = None
    #: Whether the set of states is soft.
    soft_states: bool = False
    #: Rows of nonlinear constraints at each stage, and whether some also hold at the newest state.
    constraints: int = 0
    #: Components of the w that they are functions of, where it is not d; else 0.
    constraints_w: int = 0
    constrains_end: bool = False
    #: Whether there are other rows than those of noise-free directions.
    has_inequalities: bool = False
    #: States that are held where the window does not see them.
    held: int = 0
    #: The terms of J that not every estimator has, by their names in C.
    terms: tuple[str, ...] = ()
    #: The parts of C with numbers of their own: their names, and of their numbers the names,
    #: whether they are integers, and how many there are; 0 for a single one.
    numbers_of: tuple[tuple[str, tuple[tuple[str, bool, int], ...]], ...] = ()

    @classmethod
    def of(
        cls, directions: Directions, horizon: int, real: str = "double",
        native: bool = False, clock: bool = False, restores: bool = False,
        restarts: bool = False,
    ) -> Layout:
        """The sizes and features of an estimator; if `native`, by all that is quick here."""
        system, observer, cost = directions.system, directions.observer, directions.cost
        form = cost.c_form
        losses = () if form is None else form.losses
        sets = tuple(
            (one is not None, 0 if one is None else one.matrix.shape[0])
            for one in map(system.set_of, SET_NAMES)
        )
        numbers: tuple[int, ...] | None = None
        if cost.space is not None:
            rows = directions.rows
            numbers = () if rows is None else tuple(rows.numbers.tolist())
            sets = ((rows is not None, len(numbers)), *sets[1:])
        own = observer_form(system, observer, cost)
        rule, functions = own.innovation, system.constraints
        constrained = functions is not None or any(there for there, _ in sets)
        terms = directions.terms_of(system, cost)
        native = native and directions.free is None
        vectors = native and _TILED_STATES <= system.n < _LAPACK_AFTER_TILES and has_vectors()
        return cls(
            system.n, system.p, system.m, horizon, sets, real, observer=own.name,
            widened=any(one.graduation > 1.0 for one in losses[1:]),
            loss=any(one.kind != "quadratic" for one in losses),
            own_losses=sum((one.kind == "own") << k for k, one in enumerate(losses)),
            covariance=own.prior is not None, deviations=own.deviations,
            constant_gain=observer.constant_gain is not None,
            needs_jacobians=observer.needs_jacobians,
            innovation="" if rule is None or rule.c_name is None else rule.c_name,
            sensors=len(observer.sensors), rejects=observer.rejects,
            observer_prior=cost.observer_prior is not None,
            lapack=native and system.n >= _LAPACK_STATES and not vectors, vectors=vectors,
            clock=clock,
            restores=restores and constrained, restarts=restarts,
            residuals=(_kind(system.output_residual), _kind(system.state_residual)),
            turns=system.turns is not None, quiet=directions.quiet, numbers=numbers,
            free=directions.free, soft_states="states" in system.soft, held=len(system.held),
            constraints=0 if functions is None else functions.size,
            constraints_w=0 if functions is None else functions.of_directions,
            constrains_end=functions is not None and bool(functions.on_state.any()),
            has_inequalities=(
                directions.constraints.has_inequalities or any(term.name == SOFT for term in terms)
            ),
            terms=tuple(term.name for term in terms),
            numbers_of=tuple(
                (name, tuple(
                    (k, one.dtype.kind == "i", one.size if one.ndim else 0)
                    for k, one in data.items()
                ))
                for name, data in numbers_of(
                    directions, system, cost, terms, real, USUAL, restarts * horizon
                ).items()
            ),
        )

    @property
    def number(self) -> type[Any]:
        """NumPy's type of the reals."""
        return np.float64 if self.real == "double" else np.float32

    def header_values(self, name: str) -> dict[str, Any]:
        """Values for the header's template."""
        bits = (f"    {name.upper()}_{flag.name} = {flag.value}" for flag in Status)
        values = {
            "nx": self.nx, "ny": self.ny, "nu": self.nu, "horizon": self.horizon,
            "real": self.real, "loss": int(self.loss), "own_losses": self.own_losses,
            "lapack": int(self.lapack), "clock_text": _CLOCK_TEXT if self.clock else "",
            "deviations": self.deviations,
            "constant_gain": int(self.constant_gain), "rejects": int(self.rejects),
            "needs_jacobians": int(self.needs_jacobians),
            "observer_prior": int(self.observer_prior),
            "sensors": self.sensors,
            "turns": int(self.turns), "quiet": self.quiet, "held": self.held,
            "rolled": int(self.free is not None),
            "free": self.nx if self.free is None else self.free,
            "limits": c_definitions(name.upper(), self.real), "status": ",\n".join(bits),
            "stage_members": self.sizes.c_text(True),
            "estimator_members": self.sizes.c_text(False),
        }
        values["set_members"] = "\n".join(
            _SET_TYPE.substitute(
                letter=one, count=f"MHE_SIZE(MHE_{one.upper()}_ROWS)",
                n="MHE_NY" if one == "v" else "MHE_NX",
            ) for one in "wvx"
        )
        values["part_types"], values["part_fields"] = self._part_types(name)
        for letter, (there, rows) in zip("wvx", self.sets, strict=True):
            values[f"{letter}_set"] = int(there)
            values[f"{letter}_rows"] = rows
        values["x_hard"] = int(self.projects)
        values["g_rows"], values["end_rows"] = self.constraints, int(self.ends_with_rows)
        values["g_w"] = self.constraints_w
        return values

    def _part_types(self, prefix: str) -> tuple[str, str]:
        """The structs of parts' numbers in C, and the fields of the settings that have them."""
        types, fields = [], []
        for name, data in self.numbers_of:
            rows = "".join(
                f"    {'int32_t' if whole else f'{prefix}_real'} "
                f"{field}{f'[{size}]' if size else ''};\n" for field, whole, size in data
            )
            about = "a term of J" if name in self.terms else _PARTS.get(name, f"the {name}")
            types.append(f"\n/* The numbers of {about}. */\ntypedef struct {{\n{rows}}} "
                         f"{prefix}_{name};\n")
            fields.append(f"    {prefix}_{name} {name};\n")
        return "".join(types), "".join(fields)

    def settings_type(self) -> np.dtype[Any]:
        """``mhe_settings``."""
        r, n, p = self.number, self.nx, self.ny
        loss = _struct([
            ("parameter", r), ("graduation", r), ("kind", np.int32), ("per_component", np.int32),
        ])
        fields: list[Any] = [
            ("prior_weight", r, n * n),
            ("disturbance_weight", r, n * n), ("noise_weight", r, p * p),
            ("noise_deviations", r, p), *((f"{name}_loss", loss) for name in TERMS),
            ("output_periods", r, p), ("state_periods", r, n), ("turn_middle", r, n),
        ]
        for name, data in self.numbers_of:
            fields.append((name, _struct([
                (field, np.int32 if whole else r, *((size,) if size else ()))
                for field, whole, size in data
            ])))
        fields += [
            ("discount", r), ("sample_time", r), ("tolerance", r),
            ("solver_tolerance", r),
        ]
        fields += [(name, self.set_type(name)) for name in SET_NAMES]
        fields += [(name, r, self.metric_size) for name in ("metric", "metric_weight")]
        fields += [(name, r, n) for name in ("inner_lower", "inner_upper", "aside")]
        options = (
            "metric_settled", "project", "max_qps", "uncapped", "patience", "max_iterations",
            "start_at_best", "reinitialize", "smooth",
        )
        fields += [(name, np.int32) for name in options]
        if self.clock:
            fields += [("time_budget", np.float64), ("clock", np.uintp)]
        return _struct(fields)

    def estimate_type(self) -> np.dtype[Any]:
        """``mhe_estimate``."""
        r, n, p, count = self.number, self.nx, self.ny, self.horizon
        rejected = [("rejected", np.uint8, self.sensors)] if self.sensors else []
        failed = [("trial_failed", np.uint8)] if self.constraints else []
        missed = [("missed", np.uint8, self.rows)] if self.restores else []
        return _struct([
            ("cost", r), ("candidate_cost", r), ("restored_cost", r),
            ("trajectory", r, (count + 1, n)), ("candidate", r, (count + 1, n)),
            ("disturbances", r, (count, n)), ("noises", r, (count, p)),
            ("observer_state", r, n), ("filtered", r, n),
            ("time", np.int64), ("length", np.int32), ("status", np.int32), ("qps", np.int32),
            ("iterations", np.int32), ("corrections", np.int32), ("nearest_points", np.int32),
            ("dropped", np.uint8, self.rows), *rejected, *failed, *missed,
        ])

    def set_type(self, name: str) -> np.dtype[Any]:
        """``mhe_w_set``, ``mhe_v_set`` or ``mhe_x_set``."""
        r, k = self.number, SET_NAMES.index(name)
        size, space = (self.nx, self.ny, self.nx)[k], max(self.sets[k][1], 1)
        return _struct([
            *((name, r, size) for name in ("lower", "upper", "scale", "deviation")),
            ("rows", r, space * size),
            *((f"row_{name}", r, space) for name in ("lower", "upper", "scale", "deviation")),
            ("row_fixed", np.uint8, space),
        ])

    def sample_type(self) -> np.dtype[Any]:
        """``mhe_sample``."""
        pointers = ("y", "u", "noise_weight", "disturbance_weight", *SET_NAMES, "sampled")
        return _struct([*((name, np.uintp) for name in pointers), ("step", self.number)])

    @property
    def projects(self) -> bool:
        """Whether there is a set of states in which the observer may be kept: no soft one."""
        return self.sets[2][0] and not self.soft_states

    @property
    def metric_size(self) -> int:
        """Entries of the observer's metric, of which there is one if there is X."""
        return max(self.sets[2][0] * self.nx**2, 1)

    @property
    def set_rows(self) -> tuple[int, ...]:
        """Inequalities of each set at one stage: one for each component, then the rows."""
        return tuple(
            there * (size + rows)
            for size, (there, rows) in zip(
                (self.nx, self.ny, self.nx), self.sets, strict=True
            )
        )

    @property
    def has_prior_roots(self) -> bool:
        """Whether a root of the observer's covariance may give one of the prior's weight."""
        return self.observer_prior and self.deviations > 0

    @property
    def has_rows(self) -> bool:
        """Whether there is a set or a nonlinear constraint."""
        return self.constraints > 0 or any(there for there, _ in self.sets)

    @property
    def ends_with_rows(self) -> bool:
        """Whether some rows hold at the newest state."""
        return self.sets[2][0] or self.constrains_end

    @property
    def rows(self) -> tuple[int, int]:
        """Stages of a window with rows, and rows of each, at least one."""
        count = sum(self.set_rows) + self.constraints
        return self.horizon + self.ends_with_rows, max(count, 1)

    def dropped_rows(self, sides: NDArray[np.uint8], first: int) -> tuple[DroppedRow, ...]:
        """The rows in ``dropped`` or ``missed`` of an estimate whose window starts at this time."""
        found, start = [], 0
        counts = *self.set_rows, self.constraints
        for name, count in zip((*SET_NAMES, "constraints"), counts, strict=True):
            part = sides[:, start : start + count]
            numbers: Sequence[int] = range(count)
            if name == "disturbances" and self.numbers is not None:
                numbers = [-1] * self.nx + list(self.numbers)  # no bounds of components
            found += [
                DroppedRow(
                    name, int(numbers[r]), ("lower", "upper")[part[k, r] - 1], first + int(k)
                )
                for k, r in np.argwhere(part)
            ]
            start += count
        # As the Python step lists them: those of X first.
        return tuple(sorted(found, key=lambda row: row.set != "states"))

    def estimator_type(self) -> np.dtype[Any]:
        """``mhe_estimator``."""
        r, n, p, sizes = self.number, self.nx, self.ny, self.sizes
        terms = _struct([
            ("f_jacobian", r, (n, n)), ("h_jacobian", r, (p, n)),
            *((name, r, (n, n)) for name in ("hessian", "coupling") if self.free is None),
            ("own", r, n), ("following", r, n),
            ("disturbance_scale", r, n if self.loss else 1),
            ("noise_scale", r, p if self.loss else 1),
        ])
        kinds: dict[str, Any] = {"real": r, "terms": terms}
        for letter, name in zip("wvx", SET_NAMES, strict=True):
            kinds[f"{letter}_set"] = self.set_type(name)
        stage = _struct(sizes.c_type(True, kinds))
        return _struct([
            ("settings", np.uintp), *sizes.c_type(False, kinds), ("stages", stage, self.horizon),
        ])

    @property
    def sizes(self) -> MemorySizes:
        """What the memory's table of fields needs."""
        sets = {f"{one}_set": there for one, (there, _) in zip("wvx", self.sets, strict=True)}
        return MemorySizes.of(
            self.nx, self.ny, self.nu, self.horizon, sensors=self.sensors, held=self.held,
            rows=self.rows, covariance=self.covariance, **sets,
            roots=self.deviations > 0, restarts=self.restarts,
        )


def observer_form(system: System, observer: Observer, cost: Cost) -> ObserverForm:
    """The observer in C: without its covariance where the estimator does not read it."""
    form = observer.c_form
    assert form is not None
    weighs = cost.observer_prior is not None
    projects = system.states is not None and observer.metric is None
    return form if form.plain is None or weighs or projects else form.plain


def numbers_of(
    directions: Directions, system: System, cost: Cost, terms: tuple[TermForm, ...], real: str,
    usual: Conditions, judged: int,
) -> dict[str, Mapping[str, NDArray[Any]]]:
    """The numbers of the parts of C that have some, by the parts' names.

    So many samples judge whether an observer is restarted; none where it never is.
    """
    form = observer_form(directions.system, directions.observer, directions.cost)
    found: dict[str, Mapping[str, NDArray[Any]]] = {}
    if form.prior is not None:
        found["covariances"] = _covariances(
            form, PriorWeights(system, directions.observer, cost), system, cost, real, usual
        )
    if directions.free is not None:
        found["elimination"] = directions.elimination(system, cost)
    if directions.quiet:
        found["quiet"] = directions.projections(system, cost)
    found |= {term.name: term.data for term in terms}
    if system.constraints is not None:
        found["constraints"] = system.constraints.numbers()
    if form.data:
        found["observer"] = form.data
    if form.innovation is not None:
        found["innovation"] = form.innovation.c_data(system.p)
    if judged:
        counts = range(judged * system.p + 1)
        found["restart"] = {"larger": np.array([larger(count) for count in counts])}
    return found


def _covariances(
    form: ObserverForm, prior: PriorWeights, system: System, cost: Cost, real: str,
    usual: Conditions,
) -> dict[str, NDArray[Any]]:
    """The covariances of an observer, and how they weigh the prior."""
    assert form.prior is not None
    assert form.disturbance is not None
    assert form.noise is not None
    disturbance = covariance_of(usual.disturbance_weight, form.disturbance)
    noise = covariance_of(usual.noise_weight, form.noise)
    found = {
        "initial": form.prior, "disturbance": system.state_covariance(disturbance), "noise": noise,
    }
    if cost.observer_prior is not None:
        found |= {"added": prior.added, "least_weight": prior.least}
    return found | {
        "least": np.array(SINGULAR if real == "double" else _LEAST_SINGLE),
        "noise_share": np.array(least_share(noise)),
        "typical": np.zeros(system.n) if prior.typical is None else prior.typical,
    }


def _kind(residual: Residual | None) -> int:
    return 0 if residual is None else 2 if residual.periods is None else 1


def _struct(fields: list[Any]) -> np.dtype[Any]:
    """The type of a C struct. Before NumPy 2, a size of 1 that is no tuple means a scalar."""
    return np.dtype(
        [
            (name, kind, *((size,) if isinstance(size, int) else size for size in shape))
            for name, kind, *shape in fields
        ],
        align=True,
    )
