"""``python -m examples.gallery.battery --data DIR --out results``."""

import sys

from ..command import main
from . import __doc__ as description
from .cell import draw, problems
from .measurements import SOURCE

if __name__ == "__main__":
    sys.exit(main("battery", str(description), problems, draw, SOURCE))
