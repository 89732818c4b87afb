"""Systems from FMUs for model exchange: models of Modelica tools, Simulink and others."""

from __future__ import annotations

import difflib
import hashlib
import threading
import weakref
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.values import finite, shown

from .._checks import choice, need, positive
from ..errors import InvalidInputError, ModelError
from ..model.functions import EvaluationError, Trusted
from ..model.ode import checked_method, made_from_ode
from ..model.signals import Signal, Signals
from ..model.symbols import NotTraceableError
from ..model.system import System
from ..model.system_arguments import SystemOptions
from .control import other_times
from .fmu_instance import Instance, Wiring

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

Array = NDArray[np.float64]

_REAL = {2: "Real", 3: "Float64"}
# So many names are shown of a list.
_SHOWN = 6
_DERIVATIVES = ("auto", "directional", "differences")


def from_fmu(
    path: str | PathLike[str],
    *,
    dt: float,
    outputs: Sequence[str] | None = None,
    inputs: Sequence[str] | None = None,
    parameters: Mapping[str, float | int | bool | str] | None = None,
    method: str = "rk4",
    steps: int = 1,
    tolerance: float | None = None,
    derivatives: str = "auto",
    **options: Unpack[SystemOptions],
) -> System:
    r"""Make a system from an FMU for model exchange, which Modelica tools and Simulink export.

    .. math::
        \dot x = f_c(x, u), \qquad y = h(x, u)

    The states x are the FMU's continuous states, in its order. They are integrated by this
    package, u held over the step, as `System.from_ode` does. The FMU is called state by state, by
    the Python step.

    Parameters
    ----------
    path : str or path
        A file of FMI 2.0 or 3.0, with a library for this platform, without events and discrete
        states. It is a program, which runs in this process: load none that you do not trust.
    dt : float
        Sampling time, in the time unit of the FMU, which is seconds in Modelica.
    outputs : sequence of str, optional
        The measured variables y: names of real variables that are continuous, states too. All
        continuous outputs of the FMU, in its order, if left out.
    inputs : sequence of str, optional
        The known inputs u. All continuous real inputs if left out; what is not named rests at its
        start value.
    parameters : dict, optional
        Values of parameters by name, and of inputs that rest; others have the FMU's.
    method, steps, tolerance
        As for `System.from_ode`.
    derivatives : {"auto", "directional", "differences"}
        The FMU's directional derivatives, exact if its tool is, or differences, of steps that are
        shares of ``scales``. ``"auto"`` takes the former for rate and outputs, each where the FMU
        offers them and they work.
    **options
        Sets and others, as for `System`. ``scales`` are the nominal values of the states if left
        out and at least one differs from 1.

    Returns
    -------
    System
        Its attribute `signals` has names, units, start and nominal values. It pickles as the path
        of the file, which is loaded again and must be the same. Copies of it share one instance
        of the FMU; threads take turns.

    Raises
    ------
    ModelError
        If the FMU has events, discrete states, no continuous states, is only for co-simulation or
        for another platform, depends on time, has no directional derivatives that are demanded, or
        fails.
    InvalidInputError
        If FMPy is not installed, the file is no FMU, or a name is unknown.
    OptionError, SetError
        As for `System.from_ode`.

    Notes
    -----
    An FMU for co-simulation holds its own integrator. It can restore a state that it had, as a
    block of bytes that only it can read, but not be started at any x; so f(x, u) is unknown.
    """
    arguments: dict[str, Any] = {
        "path": path, "dt": dt, "outputs": outputs, "inputs": inputs, "parameters": parameters,
        "method": method, "steps": steps, "tolerance": tolerance, "derivatives": derivatives,
        **options,
    }
    return _made(None, **arguments)


def _made(
    digest: str | None, *, path: Any, dt: float, outputs: Any, inputs: Any, parameters: Any,
    method: str, steps: int, tolerance: float | None, derivatives: str,
    **options: Unpack[SystemOptions],
) -> System:
    need("fmpy", "from_fmu", "fmu")
    how, allowed = checked_method(method, steps, tolerance)
    choice("derivatives", derivatives, _DERIVATIVES)
    file = _File(path, digest)
    chosen = _Chosen(file, outputs, inputs, parameters)
    instance = _instance(file, chosen)
    n, m, p = len(file.states), len(chosen.inputs), len(chosen.outputs)
    at_rest = np.array([_start(file, one) for one in chosen.inputs])
    _check_no_time(file, instance, at_rest, positive("dt", dt))
    model = _Functions(instance, chosen)
    slopes = model.slopes(file, derivatives, at_rest)
    if options.get("scales") is None and (instance.nominal != 1.0).any():
        options = {**options, "scales": instance.nominal}
    system = made_from_ode(
        System, _of(model.rate, m), _of(model.output, m), dt=dt, n=n, p=p, m=m, how=how,
        rate_jacobian=None if "rate" not in slopes else _of(model.rate_jacobian, m),
        h_jacobian=None if "output" not in slopes else _of(model.output_jacobian, m),
        options=options, tolerance=allowed, jacobians="fmu",
    )
    recipe = {
        "digest": file.digest, "path": str(file.path.resolve()), "dt": dt,
        "outputs": [one.name for one in chosen.outputs],
        "inputs": [one.name for one in chosen.inputs], "parameters": dict(parameters or {}),
        "method": system.method, "steps": system.steps, "tolerance": None,
        "derivatives": derivatives, **options,
    }
    return system.with_origin(
        recipe=(_made, recipe), signals=_signals(file, chosen, instance)
    )


class _File:
    """What an FMU says of itself, checked.

    Attributes
    ----------
    description
        FMPy's ``ModelDescription``.
    states, rates : list
        FMPy's variables of the continuous states and of their derivatives.
    is_directional : bool
        Whether it offers directional derivatives.
    """

    def __init__(self, path: Any, digest: str | None) -> None:
        if not isinstance(path, (str, PathLike)):
            raise InvalidInputError(f"path is {shown(path)}; expected the name of an FMU.")
        self.path = Path(path)
        from xml.etree import ElementTree  # late: `import qpmhe` does without

        try:
            self.digest = hashlib.sha256(self.path.read_bytes()).hexdigest()
            with zipfile.ZipFile(self.path) as archive:
                members = archive.namelist()
                root = ElementTree.fromstring(archive.read("modelDescription.xml"))
        except (
            OSError, ValueError, KeyError, RuntimeError, zipfile.BadZipFile, zlib.error,
            ElementTree.ParseError,
        ) as error:
            raise InvalidInputError(
                f"path is {str(path)!r}, which is no FMU that can be read ({error}); expected a "
                "zip archive with modelDescription.xml."
            ) from error
        if digest not in (None, self.digest):
            raise InvalidInputError(
                f"the FMU {self.path} has changed since the system was made; make it again by "
                "from_fmu."
            )
        version = root.get("fmiVersion", "")
        if version != "2.0" and not version.startswith("3."):
            raise self.error(f"it is of FMI {version or '(none)'}", "2.0 or 3.0; export it again")
        self.fmi = int(version[0])
        self._check_kind(root)
        fmpy = need("fmpy", "from_fmu", "fmu")
        try:
            self.description: Any = fmpy.read_model_description(str(self.path), validate=False)
        except Exception as error:
            raise ModelError(
                f"{self.path.name}: FMPy cannot read its description ({error}); "
                "fmpy.validation.validate_fmu tells more."
            ) from error
        self.exchange = self.description.modelExchange
        # Of FMI 3, FMPy (0.3.32) does not read this.
        element = root.find("ModelExchange")
        assert element is not None
        plural = "s" if self.fmi == 3 else ""
        self.is_directional = (
            element.get(f"providesDirectionalDerivative{plural}") in ("true", "1")
        )
        self.variables = {one.name: one for one in self.description.modelVariables}
        for one in self.variables.values():
            if not 0 <= one.valueReference < 2**32:  # C would read some other place
                raise self.error(
                    f"the reference of {one.name} is {one.valueReference}",
                    "one from 0 to 4294967295. Export it again"
                )
        self._check_platform(fmpy, members)
        self._check_no_events()
        self.rates = [one.variable for one in self.description.derivatives]
        self.states = [one.derivative for one in self.rates]
        self._check_states()

    def error(self, found: str, expected: str) -> ModelError:
        return ModelError(f"{self.path.name}: {found}; expected {expected}.")

    def value(self, name: str, text: Any, reader: type = float) -> Any:
        """A value in the description, which FMPy leaves a text."""
        try:
            return reader(text)
        except ValueError as error:
            raise self.error(
                f"{name} is {text!r}", f"a value of type {reader.__name__}. Export it again"
            ) from error

    def _check_kind(self, root: Element) -> None:
        if root.find("ModelExchange") is None:
            raise self.error(
                "it is only for co-simulation: it integrates by itself and restores states that it "
                "had, but cannot evaluate f at any x",
                "an FMU for model exchange. Export the model as one ('ME' in most tools)"
            )

    def _check_platform(self, fmpy: Any, members: list[str]) -> None:
        mine = fmpy.platform if self.fmi == 2 else fmpy.platform_tuple
        library = (
            f"binaries/{mine}/{self.exchange.modelIdentifier}{fmpy.sharedLibraryExtension}"
        )
        if library in members:
            return
        parts = [one.split("/") for one in members if one.startswith("binaries/")]
        others = sorted({one[1] for one in parts if len(one) > 2 and one[2]})
        remedy = "Export it for this platform"
        if any(one.startswith("sources/") and one.endswith(".c") for one in members):
            remedy += ", or compile its sources: fmpy.util.compile_platform_binary"
        raise self.error(
            f"it has no library for this platform, {library}, but for "
            f"{', '.join(others) or 'none'}", f"one for {mine}. {remedy}"
        )

    def _check_no_events(self) -> None:
        count = self.description.numberOfEventIndicators
        if count:
            raise self.error(
                f"it has {count} event indicators", "a model without events, as a System has none. "
                "In Modelica write noEvent(...) or smooth functions in the place of if and max, in "
                "Simulink disable zero-crossing detection; export it again"
            )
        discrete = [
            one.name for one in self.description.modelVariables
            if one.type == "Clock" or one.clocks or one.previous is not None or (
                one.variability == "discrete" and one.causality in ("local", "output")
            )
        ]
        if discrete:
            raise self.error(
                f"it has discrete states or values that only events change, {_listed(discrete)}",
                "continuous ones only. Take when-clauses, hysteresis and sampled blocks out, and "
                "make what they set inputs"
            )

    def _check_states(self) -> None:
        if not self.rates:
            raise self.error("it has no continuous states", "one at least, to be estimated")
        odd = [
            rate.name for rate, state in zip(self.rates, self.states, strict=True)
            if state is None or not _is_scalar(state, self.fmi)
        ]
        if odd:
            raise self.error(
                f"the derivatives {_listed(odd)} are not those of a {_REAL[self.fmi]} state "
                "without dimensions", "such states. Export the model with scalar variables"
            )

    def listed(self, causality: str) -> list[Any]:
        """The continuous real variables of a causality, without aliases' second names."""
        found, seen = [], set()
        for one in self.description.modelVariables:
            is_new = one.valueReference not in seen
            if one.causality == causality and self.is_signal(one) and is_new:
                seen.add(one.valueReference)
                found.append(one)
        return found

    def is_signal(self, variable: Any) -> bool:
        """Whether it is a continuous real variable."""
        return _is_scalar(variable, self.fmi) and variable.variability == "continuous"


class _Chosen:
    """Which variables are inputs and outputs, and which values are set at the start."""

    def __init__(self, file: _File, outputs: Any, inputs: Any, parameters: Any) -> None:
        self.inputs = _named(file, "inputs", inputs, "input")
        self.outputs = _named(file, "outputs", outputs, "output")
        if not self.outputs:
            raise file.error(
                "no output is named, and it has no continuous real ones",
                "outputs=[...], names of measured variables or states"
            )
        self.values = _values(file, parameters, {one.name for one in self.inputs})
        #: Which state an output is; -1 for others, which the FMU computes.
        places = {one.valueReference: j for j, one in enumerate(file.states)}
        self.places = np.array([places.get(one.valueReference, -1) for one in self.outputs])
        self.computed = [
            one.valueReference for one in self.outputs if one.valueReference not in places
        ]


def _named(file: _File, option: str, given: Any, causality: str) -> list[Any]:
    """The variables of these names; all of the causality if there are none."""
    if given is None:
        return file.listed(causality)
    if isinstance(given, str) or not isinstance(given, Sequence) or not all(
        isinstance(name, str) for name in given
    ):
        raise InvalidInputError(
            f"{option} is {shown(given)}; expected a sequence of names of variables."
        )
    found = [_variable(file, option, name) for name in given]
    for one in found:
        is_wrong = causality == "input" and one.causality != "input"
        if not file.is_signal(one) or is_wrong:
            raise InvalidInputError(
                f"{option} names {one.name!r} of {file.path.name}, a {one.variability} "
                f"{one.causality} of type {one.type}{' with dimensions' * bool(one.dimensions)}; "
                f"expected a continuous {'input' if is_wrong else 'variable'} of type "
                f"{_REAL[file.fmi]} without dimensions. A parameter that is to be an input must be "
                "one in the model."
            )
    references = [one.valueReference for one in found]
    if len(set(references)) < len(references):
        raise InvalidInputError(
            f"{option} is {list(given)}, which names one variable twice; expected distinct ones."
        )
    return found


def _variable(file: _File, option: str, name: Any) -> Any:
    if name not in file.variables:
        near = difflib.get_close_matches(str(name), list(file.variables), _SHOWN)
        hint = f"did you mean {_listed(near)}?" if near else (
            f"its variables are {_listed(list(file.variables))}."
        )
        raise InvalidInputError(
            f"{option} names {shown(name)}, which {file.path.name} does not have; {hint}"
        )
    return file.variables[name]


def _values(
    file: _File, given: Any, moving: set[str]
) -> dict[str, tuple[str, int, Any]]:
    """What is set before the initialisation, by name: type, reference and value."""
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise InvalidInputError(
            f"parameters is {shown(given)}; expected a dictionary of values by name."
        )
    found = {}
    for name, value in given.items():
        one = _variable(file, "parameters", name)
        if name in moving or one.causality not in ("parameter", "input") or one.dimensions:
            raise InvalidInputError(
                f"parameters names {name!r} of {file.path.name}, a {one.causality}"
                f"{' that is among the inputs u' * (name in moving)}"
                f"{' with dimensions' * bool(one.dimensions)}; expected a parameter, or an input "
                "that is not in inputs."
            )
        kind, reader = _TYPES.get(one.type, (one.type, int))
        if file.fmi == 3 and one.type == "Enumeration":
            kind = "Int64"
        if not _is_of(value, kind, reader):
            raise InvalidInputError(
                f"parameters[{name!r}] is {shown(value)}; expected a value of type {one.type}."
            )
        found[name] = (kind, one.valueReference, reader(value))
    return found


def _is_of(value: Any, kind: str, reader: type) -> bool:
    """Whether a value is one of a type; C would cut an integer that has too many bits."""
    if reader in (str, bool):
        return isinstance(value, reader)
    number = None if isinstance(value, bool) else finite(value)
    if number is None or reader is float:
        return number is not None
    bits = int(kind.rpartition("Int")[2]) if kind[-1].isdigit() else 32
    least = 0 if kind.startswith("U") else -(2 ** (bits - 1))
    return float(number).is_integer() and least <= int(value) < least + 2**bits


# What sets a variable of a type, and the type in Python; all others are integers.
_TYPES: dict[str, tuple[str, type]] = {
    "Real": ("Real", float), "Float64": ("Float64", float), "Float32": ("Float32", float),
    "Boolean": ("Boolean", bool), "String": ("String", str), "Enumeration": ("Integer", int),
}


def _is_scalar(variable: Any, fmi: int) -> bool:
    return variable.type == _REAL[fmi] and not variable.dimensions


def _listed(names: Sequence[str]) -> str:
    more = len(names) - _SHOWN
    return ", ".join(names[:_SHOWN]) + (f" and {more} more" if more > 0 else "")


# Instances by their wiring, for as long as a system uses them.
_INSTANCES: weakref.WeakValueDictionary[Wiring, Instance] = weakref.WeakValueDictionary()
_MAKING = threading.RLock()


def _instance(file: _File, chosen: _Chosen) -> Instance:
    """The instance with this wiring, shared with all systems that have it."""
    experiment = file.description.defaultExperiment
    start = file.value("the start time", getattr(experiment, "startTime", None) or 0.0)
    wiring = Wiring(
        file.digest, file.fmi, file.exchange.modelIdentifier, file.description.guid,
        _references(file.states), _references(chosen.inputs), tuple(chosen.computed),
        _references(file.rates), tuple(chosen.values.values()),
        start, file.exchange.canBeInstantiatedOnlyOncePerProcess,
    )
    with _MAKING:
        found = _INSTANCES.get(wiring)
        if found is not None:
            return found
        others = [one for one in _INSTANCES if one.digest == wiring.digest]
        if wiring.is_alone and others:
            raise file.error(
                "a process may have one instance of it, and another system has it with other "
                "inputs, outputs or parameters", "one system. Delete the other, or make one system "
                "with the outputs and inputs of both"
            )
        made = _INSTANCES[wiring] = Instance(file.path, wiring)
        return made


def _references(variables: Sequence[Any]) -> tuple[int, ...]:
    return tuple(one.valueReference for one in variables)


class _Functions:
    """Rate, output and their Jacobians over leading dimensions."""

    def __init__(self, instance: Instance, chosen: _Chosen) -> None:
        self._instance = instance
        self._places = chosen.places
        self._rates = instance.wiring.rates
        self._outputs = instance.wiring.outputs

    def rate(self, x: Array, u: Array) -> Array:
        """The states' derivatives (..., n)."""
        return _over(self._instance.rate, x, u, x.shape[-1:])

    def output(self, x: Array, u: Array) -> Array:
        """The outputs (..., p)."""
        return _over(self._output, x, u, self._places.shape)

    def rate_jacobian(self, x: Array, u: Array) -> Array:
        """The rate's derivative (..., n, n) with respect to the states."""
        return _over(
            lambda x, u: self._instance.slope(self._rates, x, u), x, u, 2 * x.shape[-1:]
        )

    def output_jacobian(self, x: Array, u: Array) -> Array:
        """The outputs' derivative (..., p, n)."""
        return _over(self._output_slope, x, u, (self._places.size, x.shape[-1]))

    def _output(self, x: Array, u: Array) -> Array:
        found = np.where(self._places >= 0, x[self._places], 0.0)
        if self._outputs:
            found[self._places < 0] = self._instance.outputs(x, u)
        return found

    def _output_slope(self, x: Array, u: Array) -> Array:
        found = np.zeros((self._places.size, x.size))
        known = np.flatnonzero(self._places >= 0)
        found[known, self._places[known]] = 1.0
        found[self._places < 0] = self._instance.slope(self._outputs, x, u)
        return found

    def slopes(self, file: _File, derivatives: str, u: Array) -> set[str]:
        """Which of ``rate`` and ``output`` have directional derivatives that are to be used."""
        if derivatives == "differences":
            return set()
        demanded = derivatives == "directional"
        if not file.is_directional:
            if demanded:
                raise file.error(
                    "it offers no directional derivatives", "an FMU that provides them. Export it "
                    "with them, or leave derivatives out for differences"
                )
            return set()
        found = set()
        for name, function in (("rate", self.rate_jacobian), ("output", self.output_jacobian)):
            try:
                function(self._instance.initial_state, u)
                found.add(name)
            except EvaluationError as error:
                if demanded:
                    raise file.error(
                        f"it offers directional derivatives, but not those of its {name} ({error})",
                        "an FMU that provides them. Name other outputs, or leave derivatives out "
                        "for differences where there are none"
                    ) from error
        return found


def _over(function: Any, x: Array, u: Array, shape: tuple[int, ...]) -> Array:
    """A function of one state, over leading dimensions."""
    if x.dtype == np.object_ or u.dtype == np.object_:
        raise NotTraceableError("it is an FMU, a compiled program that has no expression")
    if x.ndim == 1:
        found: Array = function(x, u)
        return found
    lead = x.shape[:-1]
    rows = np.empty((int(np.prod(lead)), *shape))
    states = x.reshape(len(rows), x.shape[-1])
    inputs = np.broadcast_to(u, (*lead, u.shape[-1])).reshape(len(rows), u.shape[-1])
    for i, (state, held) in enumerate(zip(states, inputs, strict=True)):
        rows[i] = function(state, held)
    return rows.reshape(*lead, *shape)


def _of(function: Any, m: int) -> Trusted:
    return Trusted(function if m else lambda x: function(x, np.zeros((*x.shape[:-1], 0))))


def _check_no_time(file: _File, instance: Instance, u: Array, dt: float) -> None:
    """Check that the model does not depend on time, which a `System` cannot express."""
    x = instance.initial_state
    try:
        first = np.concatenate((instance.rate(x, u), instance.outputs(x, u)))
        for time, then in instance.at_times(instance.wiring.start + other_times(dt), x, u).items():
            if not np.array_equal(first, then, equal_nan=True):
                raise file.error(
                    f"its derivatives and outputs at the start are {first.tolist()} and at time "
                    f"{time:g} {then.tolist()}", "a model that does not depend on time. Make "
                    "time-varying quantities inputs, whose values are known at each sample"
                )
    except EvaluationError as error:
        raise ModelError(
            f"{file.path.name}: it cannot be evaluated at its start: {error}. Give it other "
            "parameters."
        ) from error


def _start(file: _File, variable: Any) -> Any:
    """A variable's start value, which FMPy leaves a text; 0 or blank if it has none."""
    reader, start = _TYPES.get(variable.type, ("", int))[1], variable.start
    if reader is bool:
        return start in ("true", "1")
    return file.value(f"the start value of {variable.name}", start or reader(), reader)


def _signals(file: _File, chosen: _Chosen, instance: Instance) -> Signals:
    def of(variable: Any, value: Any, nominal: Any = None) -> Signal:
        declared = variable.declaredType
        unit = variable.unit or getattr(declared, "unit", None) or ""
        size = nominal or variable.nominal or getattr(declared, "nominal", None) or 1.0
        size = file.value(f"the nominal value of {variable.name}", size)
        return Signal(variable.name, unit, value, size, variable.description or "")

    def at_start(variable: Any) -> Any:
        if variable.name in chosen.values:
            return chosen.values[variable.name][2]
        return _start(file, variable)

    states = zip(
        file.states, instance.initial_state.tolist(), instance.nominal.tolist(), strict=True
    )
    x, u = instance.initial_state, np.array([_start(file, one) for one in chosen.inputs])
    measured = _Functions(instance, chosen).output(x, u).tolist()
    return Signals(
        tuple(of(*one) for one in states),
        tuple(of(one, _start(file, one)) for one in chosen.inputs),
        tuple(of(*one) for one in zip(chosen.outputs, measured, strict=True)),
        tuple(
            of(one, at_start(one)) for one in file.description.modelVariables
            if one.causality == "parameter" and not one.dimensions and one.type != "Binary"
        ),
    )
