"""Time and accuracy of qpmhe beside other tools, in one run, on the same records, in one thread.

Every estimator gets the same windows: measurements, our observer's prior z(t-N), the same
weights and model. The window's problem (eq:optiMHE) is the same for all but those marked as
solving another one. They take turns step by step, so that a change of the machine's speed meets
all. Every trajectory is judged by the same true J, and ratios are given only for those that
reach the converged J, or do not say that they converge.

    python -m pip install -r examples/benchmarks/requirements.txt
    python examples/benchmarks/compare_peers.py --quick
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

# Before numpy is imported: the libraries read these once.
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

from measurement import Measurement, measure
from peers import GROUPS, make
from problems import NAMES, named
from report import environment, picture, show, write
from rich.console import Console

from qpmhe.codegen.compiler import find_compiler

WIDTH = 130
NOTES = [
    "Read the ratios; microseconds are those of this machine and its load.",
    "Estimators take turns, --turn steps at a time. With --turn 1 each step begins with the "
    "caches that another estimator left, which makes short steps 1.5 to 4 times as long.",
    "Times are the wall clock's, less those in which another process had the processor.",
    "Timed are full windows from step 2 N on. Until then only the recursive estimators "
    "(qpmhe, EKF) run, on growing windows.",
    "Peers are handed the observer's trajectory, prior and window; qpmhe's time includes them, "
    "and the verdict by the true J.",
    "qpmhe: NumPy model, traced, or model from qpmhe.from_casadi, whose functions are compiled in "
    "C; compiled: the whole step in C, of a CasADi model where nothing else is said. start best: "
    "from the shifted previous estimate, where its J is lower.",
    "CasADi's programs: (x), the states are the variables; (x, w), the disturbances as well; C, "
    "functions (sqpmethod: all of it) compiled, else in CasADi's virtual machine. Compare like "
    "with like. They start at their own previous solution, shifted, unless --start candidate.",
    "Largest difference: of any state in any trajectory from that of our converged estimate, in "
    "standard deviations of the prior.",
    "Setup: seconds to import and build, once. Compiled libraries are kept on disk for the next "
    "run.",
    "All problems here are without constraints. acados does not come from PyPI: it runs where "
    "ACADOS_SOURCE_DIR is set. ModelPredictiveControl.jl is not run.",
]


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--problem", nargs="+", choices=NAMES, default=list(NAMES))
    parser.add_argument("--peers", nargs="+", choices=GROUPS, default=list(GROUPS))
    parser.add_argument("--steps", type=int, help="samples of each record; more than 2 N")
    parser.add_argument("--seeds", type=int, help="number of records")
    parser.add_argument("--turn", type=int, default=10, help="steps that one does in turn")
    parser.add_argument("--quick", action="store_true", help="one short record, nothing compiled")
    parser.add_argument(
        "--compiled", action=argparse.BooleanOptionalAction,
        help="also run the peers with functions compiled in C (minutes on the chains); by "
        "default where there is a compiler, and not with --quick",
    )
    parser.add_argument(
        "--start", choices=("shifted", "candidate"), default="shifted",
        help="where CasADi's solvers start: at their own previous solution, or as qpmhe does",
    )
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder")
    parser.add_argument("--json", type=Path, help="JSON file; <out>/peers.json if left out")
    chosen = parser.parse_args()
    if chosen.compiled is None:
        chosen.compiled = not chosen.quick and find_compiler() is not None
    chosen.seeds = chosen.seeds or (1 if chosen.quick else 3)
    return chosen


def main() -> None:
    chosen = arguments()
    console = Console()
    if console.width < WIDTH:
        console = Console(width=WIDTH)  # rather wrapped by the terminal than cut
    surroundings = environment([])
    results: list[Measurement] = []
    with console.status("") as status:
        for name in chosen.problem:
            problem = named(name)
            steps = chosen.steps or (
                2 * problem.horizon + 12 if chosen.quick else problem.scenario.steps
            )
            if steps <= 2 * problem.horizon:
                console.print(f"{name}: --steps must be more than {2 * problem.horizon}.")
                raise SystemExit(2)
            peers = make(tuple(chosen.peers), problem, chosen.compiled, chosen.start)
            if chosen.quick:
                for peer in peers:
                    peer.most_calls = peer.most_calls and 3
            results.append(
                measure(problem, peers, chosen.seeds, steps, chosen.turn, status.update)
            )
            show(console, results[-1])
            picture(results[-1], chosen.out / f"peers_{name}.png")
    packages = {one.peer.package for result in results for one in result.series} - {""}
    surroundings["versions"] = environment(packages)["versions"]
    notes = [*NOTES, *_limitations(results)]
    path = chosen.json or chosen.out / "peers.json"
    write(path, surroundings, results, notes)
    versions = ", ".join(f"{name} {number}" for name, number in surroundings["versions"].items())
    console.print(
        f"\n{surroundings['cpu']}, {surroundings['cores']} cores of which one is used, load "
        f"{surroundings['load_at_start']:.1f} at the start; Python {surroundings['python']}, "
        f"{versions}; {surroundings['c_compiler']} {surroundings['c_flags']}", highlight=False,
    )
    for note in notes:
        console.print(f"- {note}", highlight=False, markup=False)
    console.print(f"Written: {path} and pictures in {chosen.out}", highlight=False)
    # Others may be missing here; an estimator of ours that cannot be made is a fault.
    if any(
        name.startswith("qpmhe") and reason.startswith("setup:")
        for result in results for name, reason in result.left_out
    ):
        raise SystemExit(1)


def _limitations(results: list[Measurement]) -> list[str]:
    texts = (one.peer.limitations for result in results for one in result.series)
    return list(dict.fromkeys(text for text in texts if text))


if __name__ == "__main__":
    main()
