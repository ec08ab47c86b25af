"""What commands print: facts a line each, tables in columns, or one JSON value for programs."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any, Final

import click
import msgspec

from mesh.errors import AiraError
from mesh.running import fail

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

GAP: Final = "  "
"""Between two columns."""
LARGEST: Final = 2**53
"""Whole numbers from here on lose digits in programs that read JSON numbers as doubles; they are printed as text."""


def with_json(function: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the flag `--json`; it is called with `as_json`."""
    return click.option("--json", "as_json", is_flag=True, help="print JSON, and nothing else, to stdout")(function)


def say(text: str = "") -> None:
    """Print a line to stdout. Where that can't be written, say so to stderr and exit with 1."""
    try:
        click.echo(text)
    except BrokenPipeError:  # whoever read it has left, which click ends quietly
        raise
    except OSError as error:
        with open(os.devnull, "w") as nowhere:  # what is left in the buffer would fail again at the end
            os.dup2(nowhere.fileno(), sys.stdout.fileno())
        fail(AiraError(f"can't write to stdout: {error.strerror}"))


def print_json(value: Any) -> None:
    """Print one JSON value on a line. Structs have the names that they have on the wire."""
    say(msgspec.json.encode(_exact(msgspec.to_builtins(value))).decode())


def print_facts(facts: Mapping[str, object]) -> None:
    """Print a name and what is known of it on each line, in two columns. What is None is left out."""
    known = {name: str(fact) for name, fact in facts.items() if fact is not None}
    width = max(map(len, known), default=0)
    for name, fact in known.items():
        say(f"{name:<{width}}{GAP}{fact}".rstrip())


def print_table(head: Sequence[str], rows: Sequence[Sequence[object]], *, numbers: Sequence[str] = ()) -> None:
    """Print rows below their heads, in columns as wide as they need to be; those named in `numbers` end in line."""
    cells = [list(head), *([str(cell) for cell in row] for row in rows)]
    widths = [max(len(row[place]) for row in cells) for place in range(len(head))]
    for row in cells:
        columns = zip(head, row, widths, strict=True)
        aligned = (cell.rjust(width) if name in numbers else cell.ljust(width) for name, cell, width in columns)
        say(GAP.join(aligned).rstrip())


def visible(text: str) -> str:
    """A stranger's text as people may see it: it must not steer the terminal."""
    return "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text)


def plural(count: int, one: str) -> str:
    """A count of things: `1 block`, `2 blocks`."""
    return f"{count:,} {one}" if count == 1 else f"{count:,} {one}s"


def _exact(value: Any) -> Any:
    match value:
        case dict():
            return {name: _exact(member) for name, member in value.items()}
        case list() | tuple():
            return [_exact(member) for member in value]
        case int() if abs(value) >= LARGEST:
            return str(value)
    return value
