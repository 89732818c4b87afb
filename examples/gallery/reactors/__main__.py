"""``python -m examples.gallery.reactors --out results``."""

import sys

from ..command import main
from .reactors import draw, problems

if __name__ == "__main__":
    sys.exit(main("reactors", "Two textbook reactors, simulated.", problems, draw))
