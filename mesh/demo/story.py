"""Telling what happens: a line an event for people, or a JSON object a line for programs."""

from __future__ import annotations

import sys
from typing import Any, Final, Protocol

import msgspec
from rich.console import Console
from rich.text import Text

COLOURS: Final = {
    "market": "cyan",
    "person": "magenta",
    "robot": "green",
    "provider": "yellow",
    "contract": "blue",
    "device": "bright_red",
}


class Story(Protocol):
    """Somebody who is told, event by event."""

    def tell(self, who: str, event: str, words: str, **facts: Any) -> None:
        """`who` does something: `event` and `facts` for programs, `words` for people."""

    def end(self, **facts: Any) -> None:
        """The story is over; `facts` sum it up."""


class SpokenStory:
    """Plain words, coloured on a terminal; as wide as they need to be, so that addresses stay whole."""

    def __init__(self) -> None:
        self._console = Console(file=sys.stdout, soft_wrap=True, highlight=False)

    def chapter(self, title: str) -> None:
        """What the following lines are about."""
        self._console.print()
        self._console.print(Text(title, style="bold"))

    def tell(self, who: str, event: str, words: str, **facts: Any) -> None:
        """Say it."""
        first, *rest = words.splitlines()
        self._console.print(Text.assemble((f"  {who:<9}", COLOURS.get(who, "")), " ", first))
        for line in rest:
            self._console.print(Text(" " * 12 + line, style="dim"))

    def end(self, **facts: Any) -> None:
        """Say how it went."""
        paid = "paid" if facts["paid"] else "refunded"
        self._console.print()
        self._console.print(Text(f"Done in {facts['seconds']:.1f} s: the job was {paid}.", style="bold"))


class JsonStory:
    """A JSON object a line; the last one is the sum."""

    def chapter(self, title: str) -> None:
        """Programs need no titles."""

    def tell(self, who: str, event: str, words: str, **facts: Any) -> None:
        """Print the event's facts."""
        self._print({"event": event, "who": who, **facts})

    def end(self, **facts: Any) -> None:
        """Print the sum."""
        self._print(facts)

    @staticmethod
    def _print(line: dict[str, Any]) -> None:
        print(msgspec.json.encode(line).decode(), flush=True)
