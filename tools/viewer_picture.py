"""Take the picture of the viewer for the documentation: the demo's scene, in a headless Chromium.

make demo
.venv/bin/python -m tools.viewer_picture
"""

import argparse
import time
from pathlib import Path

from PIL import Image

from tests.viewer.browser import Browser

ROOT = Path(__file__).parents[1]
#: where the sine of the demo has bent the robot most to the side, as a part of its time
AT = 0.43


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Take the picture of the viewer for the documentation.")
    parser.add_argument("--scene", type=Path, default=ROOT / "demo" / "scene.html")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images" / "viewer.png")
    given = parser.parse_args()
    browser = Browser(1280, 760)
    try:
        browser.open(given.scene.resolve().as_uri())
        browser.run("document.getElementById('hint-close').click()")
        browser.drag("#time", AT)
        # shadows and smooth edges come once nothing moves
        time.sleep(1.5)
        browser.picture(given.out)
    finally:
        browser.close()
    with Image.open(given.out) as image:
        image.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(given.out, optimize=True)


if __name__ == "__main__":
    main()
