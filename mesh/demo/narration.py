"""The demo's output: lines of text for people, or JSON objects, one per line, for programs."""

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


class Narrator(Protocol):
    """Reports the demo, event by event."""

    def chapter(self, title: str) -> None:
        """Begin a chapter."""

    def event(self, who: str, event: str, text: str, **facts: Any) -> None:
        """Report what `who` does: `event` and `facts` for programs, `text` for people."""

    def summary(self, **facts: Any) -> None:
        """Report the end."""


class TextNarrator:
    """Reports in plain text, coloured on a terminal. Lines are not wrapped, so that addresses stay whole."""

    def __init__(self) -> None:
        self._console = Console(file=sys.stdout, soft_wrap=True, highlight=False)

    def chapter(self, title: str) -> None:
        """Print the title after an empty line."""
        self._print(Text(), Text(title, style="bold"))

    def event(self, who: str, event: str, text: str, **facts: Any) -> None:
        """Print the text, further lines indented."""
        first, *rest = text.splitlines()
        line = Text.assemble((f"  {who:<9}", COLOURS.get(who, "")), " ", first)
        self._print(line, *(Text(" " * 12 + more, style="dim") for more in rest))

    def summary(self, **facts: Any) -> None:
        """Print how long it took, and whether the robot was paid."""
        paid = "paid" if facts["paid"] else "refunded"
        self._print(Text(), Text(f"Done in {facts['seconds']:.1f} s: the job was {paid}.", style="bold"))

    def _print(self, *lines: Text) -> None:
        with self._console.capture() as rendered:
            for line in lines:
                self._console.print(line)
        _write(rendered.get())


class JsonNarrator:
    """Prints a JSON object for each event; the last one is the summary."""

    def chapter(self, title: str) -> None:
        """Print nothing."""

    def event(self, who: str, event: str, text: str, **facts: Any) -> None:
        """Print the event's facts."""
        self._print({"event": event, "who": who, **facts})

    def summary(self, **facts: Any) -> None:
        """Print the facts."""
        self._print(facts)

    @staticmethod
    def _print(line: dict[str, Any]) -> None:
        _write(msgspec.json.encode(line).decode() + "\n")


def _write(text: str) -> None:
    """Write to stdout. If its reader closes it (`aira demo | head`), the demo continues without output."""
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except BrokenPipeError:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), sys.stdout.fileno())
