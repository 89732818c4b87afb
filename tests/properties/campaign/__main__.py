"""A long campaign: ``python -m tests.properties.campaign FIRST SECONDS OUT [--engine compiled]``.

Random estimators with everything mixed, one for each seed from FIRST on. Each step is judged by
plain NumPy, arrays that go in and out are overwritten, and a compiled step is compared with the
Python step from the same memory. Faults go to OUT.faults, a JSON object a line; counts to
OUT.json, with the next seed, from which the same command goes on. With ``--seed`` one estimator
runs, and its faults are printed.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import warnings
from collections import Counter
from pathlib import Path

from qpmhe.codegen import compiler

from .run import run


def campaign(first, seconds, out, engine):
    """Run seeds until the time is up; the number of faults."""
    faults, table, began = Path(f"{out}.faults"), Path(f"{out}.json"), time.monotonic()
    counts, seed, before = Counter(), first, 0.0
    if table.exists():
        kept = json.loads(table.read_text(encoding="utf-8"))
        counts, seed, before = Counter(kept["counts"]), kept["next"], kept["seconds"]
        if "running" in kept:  # it was ended there, by a crash or by somebody
            counts[f"ended at seed {seed}"], seed = 1, seed + 1

    def save(spent, **running):
        kept = {"next": seed, "seconds": before + spent, "counts": dict(sorted(counts.items()))}
        new = table.with_suffix(".new")
        new.write_text(json.dumps(kept | running, indent=1), encoding="utf-8")
        os.replace(new, table)

    while (spent := time.monotonic() - began) < seconds:
        save(spent, running=seed)
        found, failures, words = run(seed, engine)
        counts += found
        counts["faults"] += len(failures)
        with faults.open("a", encoding="utf-8") as file:
            for kind, detail in failures:
                file.write(json.dumps({
                    "seed": seed, "engine": engine, "kind": kind, "detail": detail, "case": words,
                }) + "\n")
        seed += 1
    save(time.monotonic() - began)
    return counts["faults"]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("first", type=int, nargs="?", default=0)
    parser.add_argument("seconds", type=float, nargs="?", default=60.0)
    parser.add_argument("out", nargs="?", default="campaign")
    parser.add_argument("--engine", choices=("python", "compiled"), default="python")
    parser.add_argument("--seed", type=int)
    parser.add_argument("--level", help="options of the C compiler, such as -O1")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    if given.level:
        compiler._LEVELS = (tuple(given.level.split()), *compiler._LEVELS[1:])
    if given.seed is None:
        return 1 if campaign(given.first, given.seconds, given.out, given.engine) else 0
    counts, faults, words = run(given.seed, given.engine)
    print(words, *(f"{name}: {number}" for name, number in sorted(counts.items())), sep="\n")
    print(*(f"FAULT {kind}: {detail}" for kind, detail in faults), sep="\n")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
