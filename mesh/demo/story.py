"""Telling what happens: a line an event for people, or a JSON object a line for programs."""

from __future__ import annotations

import os
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
        self._say(Text(), Text(title, style="bold"))

    def tell(self, who: str, event: str, words: str, **facts: Any) -> None:
        """Say it."""
        first, *rest = words.splitlines()
        spoken = Text.assemble((f"  {who:<9}", COLOURS.get(who, "")), " ", first)
        self._say(spoken, *(Text(" " * 12 + line, style="dim") for line in rest))

    def end(self, **facts: Any) -> None:
        """Say how it went."""
        paid = "paid" if facts["paid"] else "refunded"
        self._say(Text(), Text(f"Done in {facts['seconds']:.1f} s: the job was {paid}.", style="bold"))

    def _say(self, *lines: Text) -> None:
        with self._console.capture() as rendered:
            for line in lines:
                self._console.print(line)
        _write(rendered.get())


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
        _write(msgspec.json.encode(line).decode() + "\n")


def _write(text: str) -> None:
    """Write to stdout. When its reader has left (`aira demo | head`), the demo goes on unheard."""
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except BrokenPipeError:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), sys.stdout.fileno())
