"""Builds the site: `python -m documentation`, after `make docs` has installed what it is built with.

The pages are put together in build/docs/pages: those of docs/, and those that are made from the source. Zensical makes
the site of them, strictly: a link or an anchor that leads nowhere fails. Then the site itself is checked.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from typing import TYPE_CHECKING, Final

from documentation.checks import problems
from documentation.navigation import navigation
from documentation.reference import reference
from documentation.staging import ROOT, places, stage

if TYPE_CHECKING:
    from pathlib import Path

BUILD: Final = ROOT / "build" / "docs"
ZENSICAL: Final = ROOT / "build" / "docs-tools" / "bin" / "zensical"


def put_together(build: Path) -> None:
    """Write all pages, and what Zensical makes the site of."""
    pages = build / "pages"
    shutil.rmtree(pages, ignore_errors=True)
    generated = reference()
    if twice := sorted(set(generated).intersection(places().values())):
        raise FileExistsError(f"docs/ has pages that are made from the source: {', '.join(twice)}")
    stage(pages, generated)
    for name, text in generated.items():
        (pages / name).parent.mkdir(parents=True, exist_ok=True)
        (pages / name).write_text(text, encoding="utf-8")
    own = ROOT / "documentation"
    shutil.copy(own / "extra.css", pages)
    shutil.copy(ROOT / "bridges" / "web" / "app" / "public" / "icon.svg", pages)
    configuration = (own / "zensical.toml").read_text(encoding="utf-8")
    before, heading, rest = configuration.partition("[project]\n")
    (build / "zensical.toml").write_text(f"{before}{heading}nav = {navigation(pages)}\n{rest}", encoding="utf-8")


def main() -> int:
    """Build the site and check it; what to exit with."""
    begun = time.monotonic()
    put_together(BUILD)
    shutil.rmtree(BUILD / "site", ignore_errors=True)
    words = (ZENSICAL, "build", "--strict", "--clean")
    done = subprocess.run(words, cwd=BUILD, capture_output=True, text=True, check=False)
    if done.returncode:
        print(done.stdout, done.stderr.partition("Traceback")[0], sep="", file=sys.stderr)
        return 1
    site = BUILD / "site"
    if found := problems(site):
        print("\n".join(found), file=sys.stderr)
        return 1
    pages = sum(1 for _ in site.rglob("*.html"))
    print(f"{pages} pages in {time.monotonic() - begun:.0f} s; this serves them:")
    print(f"python3 -m http.server --bind 127.0.0.1 --directory {site.relative_to(ROOT)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
