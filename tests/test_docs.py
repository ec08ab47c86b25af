"""The documents name files, headings and parts of the source that exist."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

from documentation.reference import reference

ROOT = Path(__file__).parents[1]
TOP = (ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md"))
PAGES = (*TOP, *sorted((ROOT / "docs").rglob("*.md")), *sorted((ROOT / "examples").rglob("*.md")))
SOURCE = re.compile(r"`((?:schemas|mesh|bridges|tests|bench|contracts|deploy|peers|examples)/[\w./-]*)`")
LINK = re.compile(r"\]\((?!https?:|#)([^)#]+)")
ANCHOR = re.compile(r"\]\((?!https?:)([^)#]*)#([^)]+)\)")
BUTTON = re.compile(r"(?<!under )(?<!\*)\*([A-Z][^*]+?)(?: \d+ XRT)?\*(?!\*)")
ABOUT_THE_PAGE = (
    *sorted((ROOT / "docs/tutorials").glob("*.md")),
    *(ROOT / f"docs/guides/{name}.md" for name in ("lessons", "page")),
)
RECORD = re.compile(r"^([A-Z]\w*_(?:LIMITS|PACE)): Final", re.MULTILINE)
PARTS = re.compile(r"`((?:schemas|mesh|bridges)/[\w/]+\.py)`: (`[\w.]+`(?:,\s`[\w.]+`)*)")


@pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])
def test_every_file_that_a_page_names_exists(page: Path) -> None:
    text = page.read_text()
    named = [ROOT / path for path in SOURCE.findall(text)] + [page.parent / path for path in LINK.findall(text)]

    assert [str(path) for path in named if not path.exists() and path.resolve() not in made()] == []


@pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])
def test_every_heading_that_a_page_links_to_exists(page: Path) -> None:
    linked = [(page.parent / path if path else page, anchor) for path, anchor in ANCHOR.findall(page.read_text())]

    assert [(str(path), anchor) for path, anchor in linked if anchor not in anchors(path)] == []


@pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])
def test_every_part_that_a_page_names_is_in_its_file(page: Path) -> None:
    missing = [
        (path, name)
        for path, names in PARTS.findall(page.read_text())
        for name in re.findall(r"[\w.]+", names)
        if not all(re.search(rf"\b{part}\b", (ROOT / path).read_text()) for part in name.split("."))
    ]

    assert missing == []


def test_every_record_of_limits_is_on_a_page_of_limits() -> None:
    pages = "".join((ROOT / f"docs/reference/{name}.md").read_text() for name in ("limits", "floods"))
    listed = {(path, name) for path, names in PARTS.findall(pages) for name in re.findall(r"\w+", names)}
    sources = [path for package in ("schemas", "mesh", "bridges") for path in (ROOT / package).rglob("*.py")]
    records = {(str(path.relative_to(ROOT)), name) for path in sources for name in RECORD.findall(path.read_text())}

    assert len(records) > 80
    assert sorted(records - listed) == []


@pytest.mark.parametrize("page", ABOUT_THE_PAGE, ids=[page.stem for page in ABOUT_THE_PAGE])
def test_what_is_to_be_pressed_is_called_so_on_the_page(page: Path) -> None:
    texts = (ROOT / "bridges/web/app/src/texts.ts").read_text()

    assert [button for button in BUTTON.findall(page.read_text()) if button not in texts] == []


@cache
def made() -> dict[Path, str]:
    """The pages that `make docs` makes from the source, where the others link to them."""
    return {ROOT / "docs" / name: text for name, text in reference().items()}


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    text = made().get(page.resolve()) or page.read_text()
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    named = re.findall(r"\{ #([\w-]+) \}$", text, re.MULTILINE)
    return {*named, *(re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings)}
