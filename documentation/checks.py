"""Checks of the built site: each link leads somewhere, and nothing is loaded from another host."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from typing import TYPE_CHECKING, Final
from urllib.parse import unquote, urldefrag

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

LOADS: Final = frozenset(
    {
        *(("audio", "src"), ("embed", "src"), ("iframe", "src"), ("img", "src"), ("img", "srcset"), ("link", "href")),
        *(("object", "data"), ("script", "src"), ("source", "src"), ("source", "srcset"), ("video", "src")),
    }
)
"""Attributes of elements whose value a browser loads at once."""
ELSEWHERE: Final = re.compile(r"\s*(?:[a-z][a-z0-9+.-]*:)?//", re.IGNORECASE)
IN_STYLES: Final = re.compile(r"(?:url\(|@import)\s*[\"']?\s*((?:https?:)?//[^\"')\s]+)", re.IGNORECASE)
LOADED_BY_SCRIPTS: Final = ("mermaid",)
"""Classes of elements for which the site's script loads another one from another host."""


class Page(HTMLParser):
    """What a built page refers to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str] = {""}
        self.links: set[str] = set()
        self.loaded: set[str] = set()
        self.styles: set[str] = set(IN_STYLES.findall(text))
        self.classes: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what an element refers to, and what refers to it."""
        if tag == "link" and ("rel", "canonical") in attrs:
            return  # not loaded, and right only where the site is served from the root of a host
        for name, given in attrs:
            value = given or ""
            if name in ("id", "name"):
                self.anchors.add(value)
            elif name == "class":
                self.classes |= set(value.split())
            if (tag, name) in LOADS:
                self.loaded.add(value)
            elif name == "href":
                self.links.add(value)


def problems(site: Path) -> list[str]:
    """What is wrong with a built site, a line each."""
    pages = {path: Page(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}
    found = [f"{path.relative_to(site)}: {wrong}" for path in pages for wrong in _wrong(path, pages, site)]
    for style in sorted(site.rglob("*.css")):
        others = IN_STYLES.findall(style.read_text(encoding="utf-8"))
        found += [f"{style.relative_to(site)}: loads {other} from another host" for other in others]
    return found


def _wrong(path: Path, pages: dict[Path, Page], site: Path) -> Iterator[str]:
    page = pages[path]
    for other in sorted({each for each in page.loaded if ELSEWHERE.match(each)} | page.styles):
        yield f"loads {other} from another host"
    for name in sorted(page.classes.intersection(LOADED_BY_SCRIPTS)):
        yield f"has an element of class {name!r}, whose script is on another host"
    if path.name == "404.html":  # served for any address, so its links begin at the site's root
        return
    for link in sorted(page.links | page.loaded):
        if ELSEWHERE.match(link) or re.match(r"(?:data|mailto|javascript):", link):
            continue
        address, anchor = urldefrag(unquote(link))
        aim = (path.parent / address).resolve() if address else path
        aim = aim / "index.html" if aim.is_dir() else aim
        if not aim.is_relative_to(site.resolve()) or not aim.exists():
            yield f"links to {link}, which does not exist"
        elif aim in pages and anchor not in pages[aim].anchors:
            yield f"links to {link}, which {aim.relative_to(site)} has no anchor for"
