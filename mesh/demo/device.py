"""The demo's device: a lamp that does what an objective tells it, and says so."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final

from schemas import Empty, String

if TYPE_CHECKING:
    from mesh.demo.story import Story
    from mesh.work.job import Job

BLINK: Final = 0.1
"""Seconds that the lamp is lit for a message."""
SHOWN: Final = 60
"""Characters of a message that are shown."""


class Lamp:
    """An LED: any message makes it blink, a String in the colour that it names."""

    def __init__(self, story: Story) -> None:
        self._story = story
        self.blinks = 0
        """How often it has blinked."""

    async def play(self, job: Job, message: Any) -> None:
        """Blink once, and publish `on` and `off` on the job's topic `/led`."""
        colour = message.data if isinstance(message, String) else ""
        self._story.tell("robot", "played", f"plays {_shown(message)}", message=_shown(message))
        await self._switch(job, "on", colour)
        await asyncio.sleep(BLINK)
        await self._switch(job, "off", colour)
        self.blinks += 1

    async def _switch(self, job: Job, state: str, colour: str) -> None:
        name = f"{colour} LED" if colour in ("red", "blue") else "LED"
        lamp = "●" if state == "on" else "○"
        self._story.tell("device", "led", f"{lamp} {name} {state}", state=state, colour=colour)
        job.publish("/led", String(f"{colour} {state}".strip()))


def _shown(message: Any) -> str:
    """A message as people may see it: an objective is anybody's, and must not steer the terminal."""
    if isinstance(message, Empty):
        return "std_msgs/Empty"
    text = f"{len(message)} bytes" if isinstance(message, bytes) else str(getattr(message, "data", message))
    shown = "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text[:SHOWN])
    return shown if len(text) <= SHOWN else f"{shown}…"
