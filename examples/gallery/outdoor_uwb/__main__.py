"""``python -m examples.gallery.outdoor_uwb --data DIR --out results``."""

import sys

from ..command import main
from . import __doc__ as description
from .tag import SOURCE, draw, problems

if __name__ == "__main__":
    sys.exit(main("outdoor_uwb", str(description), problems, draw, SOURCE))
