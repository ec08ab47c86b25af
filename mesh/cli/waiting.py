"""What commands print while they wait: the progress of a demand and its job, and losses of the router."""

from __future__ import annotations

import asyncio
import threading
from collections import Counter
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any, Final, TypeVar

import click

from mesh.cli.output import plural, print_json, print_line, printable, progress

if TYPE_CHECKING:
    from collections.abc import Callable

    from mesh.agent import Progress
    from mesh.amounts import Unit
    from mesh.network import Network

A = TypeVar("A")

STEP: Final = 10
"""Percent of a playback after which another line is printed where there is no bar."""


class JobPrinter:
    """Prints what happens to a demand and its job: lines, and a bar on a terminal; or, `as_json`, an object for each.

    `unit` is that of the demand's token. Use it as `on_progress`, and `close` it at the end.
    """

    def __init__(self, unit: Unit, *, as_json: bool) -> None:
        self._unit = unit
        self.as_json = as_json
        self.awaited = "the payment"
        """What follows the robot's result."""
        self._bar = ExitStack()
        self._move: Callable[[int, int | None], None] | None = None
        self._percent = -STEP
        self._offers: set[str] = set()
        self._declines: dict[str, str] = {}

    def __call__(self, seen: Progress) -> None:
        """Print what happened. What can't be printed because the reader has gone is lost."""
        with suppress(BrokenPipeError):  # `wait_for_broken_pipe` ends the command
            self._print(seen)

    def _print(self, seen: Progress) -> None:
        if seen.kind == "offer" and not seen.code:
            self._offers.add(seen.agent)
        if seen.kind == "declined":
            self._declines[seen.agent] = seen.code
        if self.as_json:
            print_json(_json(seen))
        elif seen.kind == "playing":
            self._playing(seen)
        elif words := self._words(seen):
            self.close()
            print_line(words)

    def line(self, text: str, **facts: Any) -> None:
        """Print a line for people or, as JSON, its facts, if it has any."""
        if not self.as_json:
            print_line(text)
        elif facts:
            print_json(facts)

    def close(self) -> None:
        """End the bar."""
        self._bar.close()
        self._move = None

    @property
    def is_silent(self) -> bool:
        """Whether no robot has offered or declined."""
        return not self._offers and not self._declines

    def summary(self) -> str:
        """How many robots offered and declined, with the declines' codes."""
        reasons = ", ".join(f"{count} {code}" for code, count in Counter(self._declines.values()).most_common())
        declines = f"{plural(len(self._declines), 'robot')} declined" + (f" ({reasons})" if reasons else "")
        return f"{plural(len(self._offers), 'robot')} offered, {declines}"

    def _words(self, seen: Progress) -> str:
        who, why = seen.agent, f"{printable(seen.detail)} ({printable(seen.code)})".lstrip()
        match seen.kind:
            case "offer":
                return f"offer by {who}{self._difference(seen)}"
            case "declined":
                return f"declined by {who}: {why}"
            case "rejected":
                return f"provider {who} can't use the demand now: {why}"
            case "contract":
                return f"contract {seen.detail} with {who}"
            case "ready":
                return "the robot is ready"
            case "gone":
                return f"robot {who} is gone; the contract holds the cost while it waits for it"
            case "back":
                return f"robot {who} is back"
            case "result" if seen.code:
                return "the robot has given up; waiting for the chain to return the cost"
            case "result":
                return f"the robot is done; waiting for {self.awaited}"
            case "judged":
                votes = f", {seen.position} of {seen.total} needed" if seen.total > 1 else ""
                return f"juror {who} judged{votes}: {printable(seen.detail)}"
            case "unjudged" if seen.code == "disagree":
                return f"the jurors of {who} disagree: {seen.detail}"
            case "unjudged":
                return f"the validator {who} is silent: {seen.detail}"
        return ""

    def _difference(self, offer: Progress) -> str:
        if not offer.code:
            return ""
        wants = self._unit.show(int(offer.detail)) if offer.code == "other-cost" else printable(offer.detail)
        return f" for other terms: {offer.code.removeprefix('other-')} {wants}"

    def _playing(self, seen: Progress) -> None:
        import sys

        percent = 100 * seen.position // max(seen.total, 1)
        if sys.stderr.isatty():
            if self._move is None:
                self._move = self._bar.enter_context(progress("playing"))
            self._move(seen.position, seen.total)
        elif percent // STEP != self._percent // STEP:
            self._percent = percent
            print_line(f"playing: {percent} %, {seen.position:,} of {plural(seen.total, 'message')}")


def _json(seen: Progress) -> dict[str, Any]:
    facts: dict[str, Any] = {"kind": seen.kind, "agent": seen.agent}
    if seen.kind == "playing":
        return facts | {"position": seen.position, "total": seen.total}
    if seen.kind in ("judged", "unjudged"):
        facts |= {"votes": seen.position, "needed": seen.total}
    return facts | {"code": seen.code, "detail": seen.detail}


async def answer_of(ask: Callable[[], A]) -> A:
    """What `ask` returns, which asks in the terminal, in a thread that does not keep an interrupted program alive."""
    loop = asyncio.get_running_loop()
    answer: asyncio.Future[A] = loop.create_future()

    def ask_there() -> None:
        try:
            given = ask()
        except click.Abort:
            loop.call_soon_threadsafe(answer.cancel)
        else:
            loop.call_soon_threadsafe(answer.set_result, given)

    threading.Thread(target=ask_there, name="prompt", daemon=True).start()
    return await answer


async def print_connection_changes(network: Network, *, before: Callable[[], object] = lambda: None) -> None:
    """Print to stderr when the router is unreachable, and when it is back, until cancelled; call `before` that."""
    async for _ in network.changes():
        before()
        words = "connected to the router again" if network.connected else "lost the router; waiting for it"
        click.echo(f"aira: {words}", err=True)
