"""``python -m examples.gallery.stiff_and_algebraic --out results``."""

import sys

from ..command import main
from .compare import draw, problems

if __name__ == "__main__":
    sys.exit(main(
        "stiff_and_algebraic", "A stiff reactor, a fermentation and a grid, simulated.",
        problems, draw,
    ))
