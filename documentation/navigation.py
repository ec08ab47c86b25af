"""The order of the site's pages: as the first page links to them, then as their folder's does, then by name."""

from __future__ import annotations

import json
import os
import re
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from pathlib import Path

SECTIONS: Final = {
    "tutorials": "Tutorials",
    "guides": "Guides",
    "reference": "Reference",
    "reference/api": "Python",
    "reference/commands": "Commands",
    "explanation": "Explanation",
    "explanation/decisions": "Decisions",
    "examples": "Examples",
}
"""The folders whose pages are in the navigation, in this order, and what it calls them."""
ABOUT: Final = ("contributing.md", "security.md", "changelog.md", "contracts.md")
"""Pages of the last section."""


def navigation(pages: Path) -> str:
    """The setting `nav`, in TOML."""
    linked = [
        os.path.normpath(os.path.join(folder, name))
        for folder in ("", *SECTIONS)
        if (index := pages / folder / "index.md").exists()
        for name in re.findall(r"\]\(([^)#\s]+\.md)", index.read_text(encoding="utf-8"))
    ]
    ranks = {name: rank for rank, name in reversed(list(enumerate(linked)))}
    top = [folder for folder in SECTIONS if "/" not in folder and (pages / folder).is_dir()]
    sections = [_section(pages, folder, ranks) for folder in top]
    return _list(['"index.md"', *sections, _named("About", [json.dumps(name) for name in ABOUT])])


def _section(pages: Path, folder: str, ranks: dict[str, int]) -> str:
    names = [f"{folder}/{path.name}" for path in sorted((pages / folder).glob("*.md"))]
    names.sort(key=lambda name: (not name.endswith("/index.md"), ranks.get(name, len(ranks)), name))
    inner = [below for below in SECTIONS if below.startswith(f"{folder}/") and (pages / below).is_dir()]
    items = [*(_section(pages, below, ranks) for below in inner), *map(json.dumps, names)]
    items.sort(key=lambda item: not item.endswith('/index.md"'))
    return _named(SECTIONS[folder], items)


def _named(title: str, items: list[str]) -> str:
    return f"{{{json.dumps(title)} = {_list(items)}}}"


def _list(items: list[str]) -> str:
    return f"[{', '.join(items)}]"
