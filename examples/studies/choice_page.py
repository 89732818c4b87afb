"""Run the studies behind docs/how-to-choose.md, and write its tables and pictures.

    python examples/studies/choice_page.py

Tables stand between markers, ``<!-- choose:name -->`` and ``<!-- end -->``; all else of the page
is left as it is. The cells that the store has are not run again.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import choice_pictures
import choice_tables
from choice_studies import MODELS, studies
from choice_tables import Figures

from qpmhe.studies import Store, run

DOCS = Path(__file__).parents[2] / "docs"
TABLES = {
    "at-all": choice_tables.at_all,
    "observers": choice_tables.observers,
    "starts-of-observers": choice_tables.starts_of_observers,
    "outliers": choice_tables.outliers,
    "priors": choice_tables.priors,
    "horizons": choice_tables.horizons,
    "caps": choice_tables.caps,
    "starts": choice_tables.starts,
    "sets": choice_tables.sets,
}
PICTURES = {"horizons": choice_pictures.horizons, "observers": choice_pictures.observers}


def filled(page: str, name: str, text: str) -> str:
    """The page with a text between the markers of a name.

    Parameters
    ----------
    page : str
        The page.
    name : str
        Of the markers.
    text : str
        What goes between them.

    Raises
    ------
    ValueError
        Unless the page has these markers once.
    """
    form = re.compile(rf"(<!-- choose:{name} -->\n).*?(<!-- end -->)", re.DOTALL)
    found, count = form.subn(lambda match: f"{match[1]}\n{text}\n\n{match[2]}", page)
    if count != 1:
        raise ValueError(f"the page has the markers of {name!r} {count} times; expected once.")
    return found


def measured(figures: Figures, store: Store, steps: int | None) -> str:
    """Where the figures come from."""
    environment = store.meta()["environments"][-1]
    names = ("numpy", "piqp", "daqp")
    versions = ", ".join(
        f"{name} {version}" for name, version in environment["versions"].items() if name in names
    )
    record = "the zoo's number of samples" if steps is None else f"{steps} samples"
    return (
        f"{figures.count:,} runs, {figures.failures} of them failed: "
        f"{figures.seeds} seeds, records of {record}, {environment['cpu']}, {versions}."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20, help="records of each model")
    parser.add_argument("--steps", type=int, help="samples of a record; the model's if left out")
    parser.add_argument("--models", nargs="+", default=MODELS, choices=MODELS, metavar="MODEL")
    parser.add_argument("--jobs", type=int, help="cells at a time; as many as cores if left out")
    parser.add_argument("--store", type=Path, default=Path("results/choice.sqlite"))
    parser.add_argument("--page", type=Path, default=DOCS / "how-to-choose.md")
    parser.add_argument("--pictures", type=Path, default=DOCS / "img", help="their folder")
    arguments = parser.parse_args()

    chosen = studies(arguments.seeds, arguments.steps, tuple(arguments.models))
    arguments.store.parent.mkdir(parents=True, exist_ok=True)
    store = Store(arguments.store)
    for name, study in chosen.items():
        print(f"{name}: {len(study.cells())} cells", flush=True)
        run(study, store, jobs=arguments.jobs)
    figures = Figures(store.frame(), chosen.values())
    page = arguments.page.read_text(encoding="utf-8")
    for name, table in TABLES.items():
        text = table(figures)
        limit = figures.widest()
        if limit > 1.0:
            text += (
                "\n\nOver the seeds, the upper 95 % confidence limit of each error ratio is at "
                f"most {100.0 * (limit - 1.0):.1f} % above it."
            )
        page = filled(page, name, text)
    page = filled(page, "backends", choice_tables.backends(DOCS / "comparison.md"))
    page = filled(page, "measured", measured(figures, store, arguments.steps))
    arguments.page.write_text(page, encoding="utf-8")
    for name, draw in PICTURES.items():
        draw(figures, arguments.pictures / f"choose-{name}.png")
    print(f"wrote {arguments.page} and its pictures")


if __name__ == "__main__":
    main()
