"""Makes the pictures of the page in docs/pictures from the screenshots of its tests: `make pictures`."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Final

from PIL import Image

from documentation.staging import ROOT

PICTURES: Final = ROOT / "docs" / "pictures"
QUALITY: Final = 80


def screenshot(picture: str) -> str:
    """The file that a test writes for a picture: `page-job-done-phone-dark.webp` is a done job on a phone, dark.

    What a tutorial ends with has the tutorial's name.
    """
    if (ROOT / "docs" / "tutorials" / picture).with_suffix(".md").exists():
        return f"{Path(picture).stem}.png"
    found = re.fullmatch(r"page-([a-z-]+?)(-phone)?(-dark)?\.webp", picture)
    if not found:
        raise ValueError(f"{picture}: no test makes a picture of this name")
    return f"{found[1]}-{'phone' if found[2] else 'desktop'}-{'dark' if found[3] else 'light'}.png"


def main(screenshots: Path) -> int:
    """Write each picture again of which there is a screenshot; what to exit with."""
    missing = []
    for picture in sorted(PICTURES.glob("*.webp")):
        source = screenshots / screenshot(picture.name)
        if source.exists():
            with Image.open(source) as image:
                image.save(picture, quality=QUALITY, method=6)
        else:
            missing.append(picture.name)
    if missing:
        print(f"no screenshot of {', '.join(missing)}", file=sys.stderr)
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
