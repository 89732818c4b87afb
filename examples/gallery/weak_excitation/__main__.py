"""``python -m examples.gallery.weak_excitation --out results``."""

import sys

from ..command import main
from .motor import draw, problems

if __name__ == "__main__":
    sys.exit(main("weak_excitation", __doc__, problems, draw))
