"""``python -m examples.gallery.lorenz96 --out results``."""

import sys

from .lorenz import main

if __name__ == "__main__":
    sys.exit(main())
