"""``python -m examples.gallery.indoor_uwb --data DIR --out results``."""

import sys

from ..command import main
from .robot import SOURCE, draw, problems

if __name__ == "__main__":
    sys.exit(main("indoor_uwb", "A robot finds its way by distances.", problems, draw, SOURCE))
