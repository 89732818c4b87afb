"""Certificates in files, which belong to what was certified."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from qpmhe_solvers.values import shown

from .._checks import Array
from .._version import __version__
from ..errors import OptionError
from ..model.sets import ConvexSet
from ..model.system import System, checked_system
from ..observers import Observer
from .content import Content, digest
from .evidence import CertificateError, Evidence, MismatchError
from .invariance import Invariance
from .model_values import ModelValues
from .observer_bound import ObserverBound
from .properties import ObserverStability
from .regions import Region
from .sizes import Sizes

#: Of the file; a new one wherever what was proved before would not be proved today, too.
VERSION = 3
_KIND = "qpmhe certificate"
_AGAIN = "Certify again: qpmhe certify --out."
_ARRAYS = ("P", "W", "V", "gain", "Q", "R", "room")
_COUNTS = ("cells", "compared")
_NUMBERS = ("rho", "C_p", "C_w", "C_v", "kappa")


def save(bound: ObserverBound, path: str | Path) -> None:
    """Write an observer's bound to a JSON file, to be read by `load`.

    Numbers are written so that they are read bit by bit. The file has digests of what was
    certified, and one of all that it says.

    Parameters
    ----------
    bound : ObserverBound
        ``certificate.observer_bound``.
    path : str or Path
        The file; an existing one is replaced.

    Raises
    ------
    CertificateError
        If its constants were stated or changed by hand, or a function has no expression by which
        the file could know it again.
    OptionError
        If the file cannot be written.
    """
    content = bound.content
    if content is None:
        raise CertificateError(
            "the bound's constants were stated or changed by hand, so that no content belongs to "
            "them; only what certify or certify_observer returned can be stored."
        )
    if content.opaque:
        raise CertificateError(
            f"{' and '.join(content.opaque)} has no expression by which a file could know the "
            "system again; only certificates of traced systems can be stored."
        )
    rest = {
        "kind": _KIND, "version": VERSION, "qpmhe": __version__,
        "headline": bound.headline, "content": dict(content.parts), "bound": _encoded(bound),
    }
    text = json.dumps(rest | {"digest": _checksum(rest)}, indent=1, allow_nan=False)
    try:
        Path(path).write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise OptionError(f"cannot write {path}: {error.strerror}.") from error


def load(path: str | Path, system: System, observer: Observer) -> ObserverBound:
    """Read the observer's bound that `save` or ``qpmhe certify --out`` wrote.

    Parameters
    ----------
    path : str or Path
        The file.
    system, observer
        What was certified: the same expressions, sets and gain, or a `MismatchError` names what
        differs. The observer's metric may differ.

    Raises
    ------
    OptionError
        If the file cannot be read, is no such file, has another version, or was changed.
    MismatchError
        If the system or the observer is another than was certified.
    """
    checked_system(system)
    try:
        rest = json.loads(Path(path).read_text(encoding="utf-8"))
    except TypeError as error:
        raise OptionError(f"path is {shown(path)}; expected the path of a file.") from error
    except OSError as error:
        raise OptionError(f"cannot read {path}: {error.strerror}.") from error
    except ValueError as error:
        raise OptionError(f"{path} is no certificate: it is not JSON ({error}).") from error
    if not isinstance(rest, dict) or rest.get("kind") != _KIND:
        raise OptionError(
            f"{path} is no certificate of an observer, as qpmhe certify --out writes it."
        )
    if rest.get("version") != VERSION:
        raise OptionError(
            f"{path} has the version {rest.get('version')!r} (qpmhe {rest.get('qpmhe')}); expected "
            f"{VERSION}, which qpmhe {__version__} reads. {_AGAIN}"
        )
    if not _is_unchanged(rest):
        raise OptionError(f"{path} was changed since it was written. {_AGAIN}")
    bound = _decoded(rest["bound"], Content(rest["content"]), system)
    changed = bound.stability.difference(system)
    if changed:
        raise MismatchError(f"{path} is for another system: {changed}. {_AGAIN}")
    return bound.with_rows(system).of_observer(observer, system)


def _is_unchanged(rest: dict[str, Any]) -> bool:
    """Whether the digest is that of all else; it is taken out."""
    told = rest.pop("digest", None)
    try:
        return bool(told == _checksum(rest))
    except ValueError:  # a number that is not finite, which `save` writes as a text
        return False


def _checksum(rest: Mapping[str, Any]) -> str:
    return digest([json.dumps(rest, sort_keys=True, allow_nan=False)])


def _number(value: float) -> float | str:
    return float(value) if math.isfinite(value) else repr(float(value))


def _array(values: Array | None) -> Any:
    return None if values is None else _listed(values.tolist())


def _listed(value: Any) -> Any:
    return [_listed(each) for each in value] if isinstance(value, list) else _number(value)


def _read_array(value: Any) -> Array | None:
    return None if value is None else np.array(value, np.float64)


_SET = ("lower", "upper", "matrix", "row_lower", "row_upper")


def _set(given: ConvexSet) -> dict[str, Any]:
    return {name: _array(getattr(given, name)) for name in _SET}


def _read_set(given: Mapping[str, Any]) -> ConvexSet:
    lower, upper, matrix, *rows = (np.array(given[name], np.float64) for name in _SET)
    return ConvexSet(lower, upper, matrix.reshape(-1, lower.size), *rows)


def _region(region: Region) -> dict[str, Any]:
    return {
        "states": _set(region.states), "lower": _array(region.lower), "upper": _array(region.upper)
    }


def _read_region(given: Mapping[str, Any]) -> Region:
    return Region(
        _read_set(given["states"]), np.array(given["lower"], np.float64),
        np.array(given["upper"], np.float64),
    )


def _size(given: float | ConvexSet) -> Any:
    return _set(given) if isinstance(given, ConvexSet) else _number(float(given))


def _read_size(given: Any) -> float | ConvexSet:
    return _read_set(given) if isinstance(given, Mapping) else float(given)


def _invariance(found: Invariance | None) -> dict[str, Any] | None:
    return None if found is None else {
        "holds": found.holds, "text": found.text, "region": _region(found.region),
        "cells": found.cells,
    }


def _read_invariance(given: Mapping[str, Any] | None) -> Invariance | None:
    return None if given is None else Invariance(
        given["holds"], given["text"], _read_region(given["region"]), given["cells"]
    )


def _encoded(bound: ObserverBound) -> dict[str, Any]:
    """All that a bound is made of."""
    found, sizes, model = bound.stability, bound.sizes, bound.stability.model
    assert model is not None
    return {
        "stability": {name: _number(getattr(found, name)) for name in _NUMBERS}
        | {name: _array(getattr(found, name)) for name in _ARRAYS}
        | {name: getattr(found, name) for name in _COUNTS}
        | {"notes": list(found.notes), "evidence": found.evidence.value},
        "model": {each.name: _array(getattr(model, each.name)) for each in fields(ModelValues)},
        "region": _region(bound.region), "certified_region": _region(found.region or bound.region),
        "sizes": {
            "disturbance": _size(sizes.disturbance), "noise": _size(sizes.noise),
            "source": sizes.source, "deviations": sizes.deviations,
        },
        "invariance": _invariance(bound.invariance), "inner": _invariance(bound.inner),
    }


def _decoded(given: Mapping[str, Any], content: Content, system: System) -> ObserverBound:
    """The bound that was encoded."""
    stated = given["stability"]
    rest: dict[str, Any] = {name: _read_array(stated[name]) for name in _ARRAYS}
    rest |= {name: stated[name] for name in _COUNTS}
    stability = ObserverStability(
        *(float(stated[name]) for name in _NUMBERS), region=_read_region(given["certified_region"]),
        notes=tuple(stated["notes"]), **rest,
    )
    model = ModelValues(**{
        name: np.array(values, np.float64).reshape(len(values), -1)
        for name, values in given["model"].items()
    })
    for value in vars(stability).values():
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
    vars(stability).update(
        system=system, model=model, content=content, evidence=Evidence(stated["evidence"])
    )
    sizes = given["sizes"]
    return ObserverBound(
        stability, _read_region(given["region"]),
        Sizes(
            _read_size(sizes["disturbance"]), _read_size(sizes["noise"]), sizes["source"],
            sizes["deviations"],
        ),
        invariance=_read_invariance(given["invariance"]), inner=_read_invariance(given["inner"]),
    )
