"""Draw the pictures of examples and gallery: run the examples and shrink what they draw.

``python docs/img/gallery.py`` renews the examples' in some minutes, ``python docs/img/gallery.py
outliers`` one. Those of the notebooks are the ones that the notebooks hold. After ``make gallery``,
``python docs/img/gallery.py --drawn results/gallery`` shrinks what it drew.
"""

import argparse
import base64
import io
import json
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

HERE = Path(__file__).parent
EXAMPLES = HERE.parents[1] / "examples"
WIDTH, COLORS, MOST = 1000, 96, 150_000  # pixels, of a palette, bytes

# Picture: program, its options and the file that it draws.
PROGRAMS = {
    "paper-figure": (["paper_figure.py"], "paper_figure.png"),
    "outliers": (["outliers.py"], "outliers.png"),
    "closed-loop": (["closed_loop.py"], "closed_loop.png"),
    "do-mpc-masses": (["do_mpc_masses.py"], "do_mpc_masses.png"),
}
# Picture: notebook and which of its pictures.
NOTEBOOKS = {"quickstart": ("quickstart.ipynb", 0), "comparison": ("comparison.ipynb", 0)}


def drawn(command: list[str], name: str) -> Image.Image:
    """The picture that a program draws.

    Parameters
    ----------
    command : list of str
        The program in ``examples/`` and its options.
    name : str
        The file that it draws.
    """
    with TemporaryDirectory() as folder:
        program, *options = command
        subprocess.run(
            [sys.executable, EXAMPLES / program, *options, "--out", folder], check=True
        )
        with Image.open(Path(folder) / name) as image:
            return image.convert("RGB")


def held(name: str, which: int) -> Image.Image:
    """A picture among a notebook's outputs.

    Parameters
    ----------
    name : str
        The notebook in ``examples/notebooks/``.
    which : int
        Which of its pictures.
    """
    notebook = json.loads((EXAMPLES / "notebooks" / name).read_text(encoding="utf-8"))
    found = [
        output["data"]["image/png"]
        for cell in notebook["cells"] for output in cell.get("outputs", [])
        if "image/png" in output.get("data", {})
    ]
    with Image.open(io.BytesIO(base64.b64decode(found[which]))) as image:
        return image.convert("RGB")


def write(image: Image.Image, path: Path) -> None:
    """Shrink to the page's width and a palette.

    Parameters
    ----------
    image : Image
        The picture.
    path : Path
        Where it goes.

    Raises
    ------
    SystemExit
        If it is too large all the same.
    """
    if image.width > WIDTH:
        height = round(image.height * WIDTH / image.width)
        image = image.resize((WIDTH, height), Image.Resampling.LANCZOS)
    image.quantize(COLORS).save(path, optimize=True)
    size = path.stat().st_size
    if size > MOST:
        raise SystemExit(f"{path} has {size} bytes; at most {MOST} are wanted: draw less.")
    print(f"wrote {path}, {size // 1000} kB")


def main() -> None:
    """Draw those that are asked for."""
    names = [*PROGRAMS, *NOTEBOOKS]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", choices=[[], *names], help="all if left out")
    parser.add_argument("--drawn", type=Path, help="folder of the gallery's results")
    given = parser.parse_args()
    if given.drawn is not None:
        for path in sorted(given.drawn.glob("*.png")):
            with Image.open(path) as image:
                write(image.convert("RGB"), HERE / f"gallery-{path.stem.replace('_', '-')}.png")
        return
    for name in given.names or names:
        image = drawn(*PROGRAMS[name]) if name in PROGRAMS else held(*NOTEBOOKS[name])
        write(image, HERE / f"{name}.png")


if __name__ == "__main__":
    main()
