"""The blocks of code and commands in the pages."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_FENCE: Final = re.compile(r"^```(\w*)")
_COMMENT: Final = re.compile(r"^<!-- (.*?): (.*) -->$")


class Block(NamedTuple):
    """One block: fenced, or indented by four columns."""

    page: Path
    line: int
    """The line of the page on which its text begins."""
    language: str
    """What its fence says; nothing if it is indented or says nothing."""
    text: str
    note: tuple[str, str] = ("", "")
    """What a comment in the line before it says, as in `<!-- not run: it needs a server -->`."""


def blocks(page: Path) -> Iterator[Block]:
    """All blocks of a page, in order."""
    lines = page.read_text(encoding="utf-8").split("\n")
    number, note = 0, ("", "")
    while number < len(lines):
        line = lines[number]
        if found := _COMMENT.match(line):
            note = (found[1], found[2])
        elif fence := _FENCE.match(line):
            end = lines.index("```", number + 1)
            yield Block(page, number + 2, fence[1], "\n".join(lines[number + 1 : end]), note)
            number = end
        elif line.startswith("    ") and _begins_block(lines, number):
            end = number
            while end < len(lines) and lines[end].startswith("    "):
                end += 1
            yield Block(page, number + 1, "", "\n".join(each[4:] for each in lines[number:end]), note)
            number = end - 1
            # A comment is about all blocks up to the next text.
            number += 1
            continue
        if line and not _COMMENT.match(line):
            note = ("", "")
        number += 1


def _begins_block(lines: list[str], number: int) -> bool:
    """Whether an indented line is code, and does not continue an item of a list."""
    before = next((line for line in reversed(lines[:number]) if line and not line.startswith("    ")), "")
    return not lines[number - 1] and not re.match(r"(?:[-*]|\d+\.) |  ", before)
