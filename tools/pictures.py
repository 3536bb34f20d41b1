"""Run the examples at full size and keep their pictures for the documentation: `make pictures`.

python -m tools.pictures [NAME ...]
"""

import importlib
import sys
import time
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).parents[1]
PICTURES = ROOT / "docs" / "images" / "examples"
#: longer than a page: they write more than one picture, and have documents of their own
LONG = ("demo", "your_own_robot")


def names() -> list[str]:
    """The examples that draw one picture."""
    return sorted(path.stem for path in (ROOT / "examples").glob("*.py") if path.stem not in LONG)


def draw(name: str) -> Path:
    """Run an example, and keep its picture."""
    path = PICTURES / f"{name}.png"
    importlib.import_module(f"examples.{name}").main(out=str(path))
    return reduced(path)


def reduced(path: Path) -> Path:
    """Reduce a picture to 256 colours: a third of the size."""
    with Image.open(path) as image:
        small = image.convert("RGB").quantize(256, dither=Image.Dither.NONE)
    small.save(path, optimize=True)
    return path


def main() -> None:
    PICTURES.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[1:] or names():
        began = time.perf_counter()
        path = draw(name)
        seconds = time.perf_counter() - began
        print(f"{path.relative_to(ROOT)}: {path.stat().st_size // 1000} kB in {seconds:.1f} s", flush=True)


if __name__ == "__main__":
    main()
