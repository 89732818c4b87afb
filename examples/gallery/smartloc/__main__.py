"""``python -m examples.gallery.smartloc --data DIR --out results``."""

import sys

from ..command import main
from .car import draw, problems
from .record import SOURCE

if __name__ == "__main__":
    sys.exit(main("smartloc", __doc__, problems, draw, SOURCE))
