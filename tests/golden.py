"""What this tree computes beside what another commit does: ``python -m tests.golden``.

All cases of `codegen/cases.py` run with both engines, in this tree and in that of the other commit,
on the same machine in the same run. Each engine is compared with its own predecessor: all that
estimates, whole runs, covariances and sensitivities say, numbers to the last bit (0.0 and -0.0 are
equal). Each tree has processes of its own, which use nothing but its public interface. With
``--mode free`` each tree goes on from its own samples. With ``--mode resync`` each step of both
begins at a snapshot of the other commit's tree; where this tree refuses these snapshots, the case
runs freely. With ``--time`` the steps of the two trees are timed in turn instead.
"""

from __future__ import annotations

import argparse
import importlib.util
import io
import itertools
import os
import pickle
import statistics
import subprocess
import sys
import tarfile
import tempfile
import time
import warnings
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from enum import Flag
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parents[1]
TABLE = Path("tests", "codegen", "cases.py")
ENGINES = "python", "compiled"
# Largest gap that a mode allows, and largest change of J, relative to it, where decisions differ.
ALLOWED = {"free": (0.0, -np.inf), "resync": (1e-12, 1e-13)}
CLOCKS = {"step_time", "solve_time", "times", "solve_times"}
# `statuses` has the flags by name: their numbers mean nothing in another tree.
NUMBERED = {"flags"}
# Passes through a case that are timed, beside one before.
PASSES = {("python", "update"): 3, ("compiled", "update"): 15, ("compiled", "run"): 15}


# In the process of a tree.


class Tree:
    """Answers to requests, by the qpmhe of one tree."""

    def __init__(self, tree):
        import qpmhe
        import qpmhe_solvers

        for module in (qpmhe, qpmhe_solvers):
            assert Path(module.__file__).is_relative_to(tree), f"{module} is not of {tree}"
        # The table of this tree for both; where the other cannot make a case of it, its own.
        self._paths = dict.fromkeys((HERE / TABLE, Path(tree, TABLE)))
        self._tables = {}

    def names(self):
        """The names of all cases."""
        return list(self._table(HERE / TABLE).CASES)

    def _table(self, path):
        if path not in self._tables:
            spec = importlib.util.spec_from_file_location(f"cases_{len(self._tables)}", path)
            self._tables[path] = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(self._tables[path])
        return self._tables[path]

    def _case(self, name):
        """The case of a name, and its estimators by engine."""
        errors = []
        for path in self._paths:
            try:
                one = self._table(path).case(name)
                one.estimator("python")
            except Exception as error:
                errors.append(error)
            else:
                return one
        raise errors[0]

    def free(self, name, engine):
        """All that a case says, with a snapshot in its middle."""
        one = self._case(name)
        mhe, steps, found = one.estimator(engine), _steps(one), {}
        for k, (label, step) in enumerate(steps):
            if k == len(steps) // 2:
                state, mhe = mhe.state_dict(), one.estimator(engine)
                mhe.load_state_dict(state)
            found[label] = _answer(mhe, step, k % 8 == 2 or k >= len(steps) - 2)
        Y = np.array([np.resize(sample["y"], one.system.p) for sample in one.samples])
        U = np.array([sample["u"] for sample in one.samples]) if "u" in one.samples[0] else None
        run = _called(lambda: one.estimator(engine).run(Y, U))
        found["run"] = {f"run.{key}": value for key, value in run.items()}
        return found, _sizes(one, found)

    def snapshots(self, name, engine):
        """The snapshot before each step."""
        one, found = self._case(name), {}
        mhe = one.estimator(engine)
        for label, step in _steps(one):
            found[label] = mhe.state_dict()
            _called(lambda step=step: step(mhe))
        return found

    def resync(self, name, engine, snapshots):
        """What each step says that begins at its snapshot; None where one is refused."""
        one, found = self._case(name), {}
        mhe = one.estimator(engine)
        for k, (label, step) in enumerate(_steps(one)):
            try:
                mhe.load_state_dict(snapshots[label])
            except Exception:
                return None
            mhe.forget_warm_start()
            found[label] = _answer(mhe, step, k % 8 == 2)
        return found, _sizes(one, found)

    def timed(self, name, engine, call):
        """Seconds of each step that its thread was on a processor."""
        one = self._case(name)
        mhe, seconds = one.estimator(engine), []
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if call == "run":
                Y = np.array([np.resize(sample["y"], one.system.p) for sample in one.samples])
                U = [sample["u"] for sample in one.samples] if "u" in one.samples[0] else None
                began = time.thread_time()
                mhe.run(Y, U)
                return [(time.thread_time() - began) / len(Y)]
            for t, sample in enumerate(one.samples):
                began = time.thread_time()
                mhe.update(**sample)
                seconds.append(time.thread_time() - began)
                if t in one.changes:
                    mhe.set(**one.changes[t])
        return seconds


def _steps(one):
    """The calls of a case that make estimates, by what they are called: (label, function)."""
    found = []
    for t, sample in enumerate(one.samples):
        found.append((f"update {t}", lambda mhe, sample=sample: mhe.update(**sample)))
        if t in one.changes:
            found.append((f"set {t}", lambda mhe, t=t: mhe.set(**one.changes[t])))
    time = len(one.samples) - min(2, one.options["horizon"])
    late = np.resize(one.samples[time]["y"], one.system.p) + 0.1
    return [*found, (f"amend {time}", lambda mhe: mhe.amend(time, late))]


def _answer(mhe, step, whole):
    """What an estimate says; with its covariances and derivatives, if wanted."""
    found = _called(lambda: step(mhe))
    if whole and "trajectory" in found:
        values = _called(mhe.covariances)
        found |= {f"covariances.{key}".rstrip("."): value for key, value in values.items()}
        cotangent = np.cos(np.arange(found["trajectory"].size)).reshape(found["trajectory"].shape)
        slopes = _called(lambda: mhe.sensitivity().adjoint(cotangent))
        found |= {f"sensitivity.{key}": value for key, value in slopes.items()}
    return found


def _called(function):
    """What a call returns, warns of and raises, as plain values by name."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            returned = function()
            if isinstance(returned, np.ndarray):
                found = {"": returned.copy()}
            else:
                names = [name for name in dir(returned) if name[0] != "_"]
                values = {name: _plain(getattr(returned, name)) for name in names}
                left_out = CLOCKS | NUMBERED
                found = {
                    name: value for name, value in values.items()
                    if value is not _plain and name not in left_out
                }
        except Exception as error:
            found = {"error": f"{type(error).__name__}: {error}"}
    found["warnings"] = "\n".join(f"{one.category.__name__}: {one.message}" for one in caught)
    return found


def _plain(value):
    """A value of NumPy and Python alone; this function itself for what has none."""
    if isinstance(value, Flag):
        return tuple(sorted(flag.name for flag in type(value) if flag in value))
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (tuple, list)):
        parts = tuple(map(_plain, value))
        return _plain if any(part is _plain for part in parts) else parts
    return _plain


def _sizes(one, found):
    """Of residuals, sizes of the terms that cancel in them: they are rounded as these are."""
    y = np.abs([np.resize(sample["y"], one.system.p) for sample in one.samples]).astype(float)
    states = [record["trajectory"] for record in found.values() if "trajectory" in record]
    x = np.abs(np.vstack(states)).max(axis=0)
    return {
        "noises": np.where(np.isfinite(y), y, 0.0).max(axis=0),
        "disturbances": x if one.cost.disturbance.shape == (x.size, x.size) else x.max(),
    }


def serve(tree):
    """Answer requests on the standard input, until it ends."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever is printed is no answer
    one = Tree(tree)
    while True:
        try:
            name, given = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        try:
            answer = getattr(one, name)(*given), ""
        except Exception as error:
            answer = None, f"{type(error).__name__}: {error}"
        pickle.dump(answer, answers)
        answers.flush()


# In the process that compares.


class Server:
    """A process of one tree."""

    def __init__(self, tree):
        own = {
            "PYTHONPATH": os.pathsep.join((str(tree), str(Path(tree, "solvers")))),
            "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1",
        }
        self._process = subprocess.Popen(
            [sys.executable, __file__, "--serve", str(tree)], env=os.environ | own,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )

    def ask(self, name, *given):
        """The answer to a request; raises what it raised."""
        try:
            pickle.dump((name, given), self._process.stdin)
            self._process.stdin.flush()
            answer, error = pickle.load(self._process.stdout)
        except (EOFError, BrokenPipeError):
            answer, error = None, f"its process ended ({self._process.wait()})"
        if error:
            raise RuntimeError(error)
        return answer

    def __enter__(self):
        return self

    def __exit__(self, *_):
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()


@dataclass
class Comparison:
    """How two records differ: gaps by field, decisions that differ, fields that one lacks.

    A gap is relative to the largest number of the same component in the case; of texts and whole
    numbers, and where other numbers are missing, it is infinite.
    """

    samples: int = 0
    compared: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    gaps: dict[str, tuple[float, str]] = field(default_factory=dict)
    flips: list[str] = field(default_factory=list)
    bad_flips: int = 0
    lacking: set[str] = field(default_factory=set)

    def see(self, name, gap, where):
        """Take a gap of a field into account."""
        self.compared[name] += 1
        if name not in self.gaps or gap > self.gaps[name][0]:
            self.gaps[name] = gap, where


def compare(total, where, found, expected, flip=-np.inf):
    """Add the differences of the records of one case to a comparison.

    Where decisions differ and J does by no more than ``flip`` of it, no numbers are compared.
    """
    (found, _), (expected, sizes) = found, expected
    assert found.keys() == expected.keys(), where
    scales = {}
    for record in (*found.values(), *expected.values()):
        for name, value in record.items():
            if _is_float(value):
                here = _largest(name, np.asarray(value, float))
                if name in sizes and np.shape(sizes[name]) in ((), here.shape):
                    here = np.maximum(here, sizes[name])
                old = scales.get(name, 0.0)
                scales[name] = np.maximum(here, old) if np.shape(old) in ((), here.shape) else here
    for label, old in expected.items():
        new, place = found[label], f"{where}, {label}"
        total.samples += label != "run"
        total.lacking |= {f"{name} (only here)" for name in new.keys() - old.keys()}
        total.lacking |= {f"{name} (only there)" for name in old.keys() - new.keys()}
        for name in sorted(new.keys() ^ old.keys()):
            if name.endswith("error"):
                error = f"{new[name]} (here)" if name in new else f"{old[name]} (there)"
                total.flips.append(f"{place}: {name}: {error}")
                total.bad_flips += 1
        both = [name for name in old if name in new]
        other = [name for name in both if _is_decision(old[name]) and old[name] != new[name]]
        if other:
            change = _change_of_cost(new, old)
            words = "; ".join(f"{name} {old[name]} -> {new[name]}" for name in other)
            total.flips.append(f"{place}: {words}; J differs by {change:.1e} of it")
            if change <= flip:
                continue
            total.bad_flips += 1
        for name in both:
            if not _is_decision(old[name]):
                total.see(name, _gap(name, new[name], old[name], scales.get(name)), place)


def _is_float(value):
    return isinstance(value, float) or getattr(getattr(value, "dtype", None), "kind", "") == "f"


def _is_decision(value):
    """Whether a value is a choice of the step: a whole number, or names."""
    return not (isinstance(value, (float, str, np.ndarray)) or value is None)


def _largest(name, value):
    """The largest finite size of each component; of derivatives, of all."""
    size = np.where(np.isfinite(value), np.abs(value), 0.0)
    if name == "covariances":
        deviations = np.sqrt(np.einsum("kii->ki", size).max(axis=0))
        return np.outer(deviations, deviations)
    if name.startswith("sensitivity.") or (size.ndim < 2 and "cost" in name):
        return size.max(initial=0.0)
    return size.reshape(-1, size.shape[-1] if size.ndim else 1).max(axis=0, initial=0.0)


def _gap(name, new, old, scale):
    if not (_is_float(new) and _is_float(old)):
        same = type(new) is type(old) and np.array_equal(new, old)
        return 0.0 if same else np.inf
    new, old = np.asarray(new), np.asarray(old)
    if new.shape != old.shape:
        return np.inf
    other = ~((new == old) | (np.isnan(new) & np.isnan(old)))
    if not np.isfinite([new[other], old[other]]).all():
        return np.inf
    gaps = np.abs(new[other] - old[other]) / np.broadcast_to(scale, old.shape)[other]
    return float(gaps.max(initial=0.0))


def _change_of_cost(new, old):
    """The difference of J, relative to it; infinite where one has no J."""
    a, b = (float(one.get("cost", np.nan)) for one in (new, old))
    size = max(abs(a), abs(b))
    if a == b:
        return 0.0
    return abs(a - b) / size if np.isfinite(size) else np.inf


def unpacked(commit, folder):
    """The files of a commit, in a folder."""
    archive = subprocess.run(
        ["git", "archive", commit], cwd=HERE, check=True, capture_output=True
    ).stdout
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        tar.extractall(folder, **({"filter": "data"} if hasattr(tarfile, "data_filter") else {}))


def predecessor():
    """Where this branch left main; on main itself, the commit before."""
    here, base = _git("rev-parse", "HEAD"), _git("merge-base", "HEAD", "main")
    return base if base not in ("", here) else _git("rev-parse", "HEAD~1")


def _git(*arguments):
    return subprocess.run(
        ["git", *arguments], cwd=HERE, capture_output=True, text=True
    ).stdout.strip()


def compared(there, options, names):
    """Comparisons by engine, and remarks: each lane takes its share of the cases."""
    _, flip = ALLOWED[options.mode]
    totals, remarks = {engine: Comparison() for engine in options.engines}, []
    total = len(names) * len(options.engines)

    def one(before, now, name, engine):
        if options.mode == "resync":
            states = before.ask("snapshots", name, engine)
            records = [tree.ask("resync", name, engine, states) for tree in (now, before)]
            if None not in records:
                return records
            remarks.append(f"{name}, {engine}: snapshots are refused; it ran freely")
        # The predecessor second: where both have the same C, it finds it compiled.
        return [tree.ask("free", name, engine) for tree in (now, before)]

    done = itertools.count(1)

    def lane(share):
        found = []
        with Server(there) as before, Server(HERE) as now:
            for name in share:
                for engine in options.engines:
                    try:
                        found.append((name, engine, one(before, now, name, engine)))
                    except RuntimeError as error:
                        remarks.append(f"{name}, {engine}: NOT COMPARED: {error}")
                    print(f"{next(done)} of {total}: {name}, {engine}", file=sys.stderr, flush=True)
        return found

    shares = [names[k :: options.processes] for k in range(options.processes)]
    with ThreadPoolExecutor(options.processes) as pool:
        for name, engine, records in [one for share in pool.map(lane, shares) for one in share]:
            compare(totals[engine], f"{name} ({engine})", *records, flip)
    return totals, remarks


def report(totals, remarks, allowed):
    """Print what differs; how many fields and decisions differ by more than is allowed."""
    failures = sum("NOT COMPARED" in remark for remark in remarks)
    fields = sorted({name for total in totals.values() for name in total.compared})
    print(f"{'largest gaps':32}" + "".join(f"{engine:>24}" for engine in totals))
    for name in fields:
        line = f"{name:32}"
        for total in totals.values():
            gap, _ = total.gaps.get(name, (0.0, ""))
            text = "changed" if gap == np.inf else "0" if gap == 0.0 else f"{gap:.1e}"
            line += f"{text} of {total.compared.get(name, 0)}".rjust(24)
        print(line)
    for name in fields:
        for total in totals.values():
            gap, where = total.gaps.get(name, (0.0, ""))
            if gap > allowed(name):
                failures += 1
                print(f"{name} differs by {gap:.1e}, more than {allowed(name):.1e}: {where}")
    for engine, total in totals.items():
        failures += total.bad_flips
        print(f"{engine}: {total.samples} samples, {len(total.flips)} with other decisions")
        for flip in total.flips:
            print(f"  {flip}")
        for name in sorted(total.lacking):
            print(f"  not compared: {name}")
    print(*remarks, sep="\n", end="\n" * bool(remarks))
    print("the trees differ" if failures else "the trees agree")
    return failures


def speed(there, names, engines):
    """Print ratios of medians, this tree over the other, timed in turn."""
    ratios = defaultdict(dict)
    with Server(there) as before, Server(HERE) as now:
        for name in names:
            for (engine, call), passes in PASSES.items():
                if engine not in engines:
                    continue
                seconds = defaultdict(list)
                for k in range(1 + passes):
                    for tree in (before, now) if k % 2 else (now, before):
                        timed = tree.ask("timed", name, engine, call)
                        seconds[tree] += timed if k else []
                ratio = statistics.median(seconds[now]) / statistics.median(seconds[before])
                ratios[engine, call][name] = ratio
    for (engine, call), found in ratios.items():
        low, middle, high = np.quantile(list(found.values()), (0.1, 0.5, 0.9))
        print(
            f"{engine}, {call}: this tree takes {middle:.3f} of the other's time per step, median "
            f"of {len(found)} cases; {low:.3f} to {high:.3f} in eight of ten"
        )
        for name in sorted(found, key=found.get)[-3:]:
            print(f"  {found[name]:.3f}  {name}")


def main(arguments=None):
    """Compare, and return how much differs."""
    parser = argparse.ArgumentParser(prog="python -m tests.golden", description=__doc__)
    parser.add_argument("--against", metavar="COMMIT", default=predecessor(), help=(
        "the other commit (default: where this branch left main; on main, the commit before)"
    ))
    parser.add_argument("--mode", choices=list(ALLOWED), default="free")
    parser.add_argument("--tolerance", type=float, help=(
        "largest gap, relative to the component's size in the case (default: "
        + ", ".join(f"{mode} {gap:g}" for mode, (gap, _) in ALLOWED.items()) + ")"
    ))
    parser.add_argument("--allow", action="append", default=[], metavar="FIELD=GAP", help=(
        "another tolerance for a field, such as covariances=1e-14 or message=inf"
    ))
    parser.add_argument("--cases", default="*", help="a pattern of their names")
    parser.add_argument("--engines", nargs="+", choices=ENGINES, default=ENGINES)
    parser.add_argument("--processes", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--time", action="store_true", help="time the steps instead")
    options = parser.parse_args(arguments)
    own = {name: float(gap) for name, _, gap in (one.partition("=") for one in options.allow)}
    usual = ALLOWED[options.mode][0] if options.tolerance is None else options.tolerance
    os.environ.setdefault("QPMHE_CACHE_DIR", str(HERE / ".pytest_cache" / "d" / "libraries"))
    with tempfile.TemporaryDirectory() as there:
        unpacked(options.against, there)
        with Server(HERE) as now:
            names = [name for name in now.ask("names") if fnmatch(name, options.cases)]
        if not names:
            parser.error(f"no case has a name like {options.cases!r}")
        print(f"{len(names)} cases, against {_git('log', '-1', '--oneline', options.against)}")
        if options.time:
            speed(there, names, options.engines)
            return 0
        totals, remarks = compared(there, options, names)
    return report(totals, remarks, lambda name: own.get(name, usual))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        serve(sys.argv[2])
    else:
        sys.exit(min(main(), 1))
