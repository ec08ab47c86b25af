"""The demo's device, a simulated lamp, and its objective, which makes the lamp blink three times."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final

from mcap.writer import Writer

from schemas import EMPTY, Empty, String

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.demo.narration import Narrator
    from mesh.work.job import Job

BLINK_SECONDS: Final = 0.1
"""How long the lamp is on for one message."""
SHOWN: Final = 60
"""The most characters of a message that are shown."""
TOPIC: Final = "/blink"
TIMES: Final = 3
PAUSE_NS: Final = 400_000_000


class Lamp:
    """An LED that blinks for any message, in the colour that a String names."""

    def __init__(self, narrator: Narrator) -> None:
        self._narrator = narrator

    async def play(self, job: Job, message: Any) -> None:
        """Blink once, and publish `on` and `off` on the job's topic `/led`."""
        colour = message.data if isinstance(message, String) else ""
        self._narrator.event("robot", "played", f"plays {_shown(message)}", message=_shown(message))
        await self._switch(job, "on", colour)
        await asyncio.sleep(BLINK_SECONDS)
        await self._switch(job, "off", colour)

    async def _switch(self, job: Job, state: str, colour: str) -> None:
        name = f"{colour} LED" if colour in ("red", "blue") else "LED"
        symbol = "●" if state == "on" else "○"
        self._narrator.event("device", "led", f"{symbol} {name} {state}", state=state, colour=colour)
        job.publish("/led", String(f"{colour} {state}".strip()))


def write_objective(path: Path) -> None:
    """Write an MCAP recording with three std_msgs/Empty on `/blink`, 0.4 s apart. The same bytes each time."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros1", library="aira-mesh")
        schema = writer.register_schema(EMPTY.schema_name, EMPTY.schema_encoding, EMPTY.schema_data)
        channel = writer.register_channel(TOPIC, EMPTY.encoding, schema)
        for number in range(TIMES):
            at = number * PAUSE_NS
            writer.add_message(channel, log_time=at, publish_time=at, data=b"", sequence=number)
        writer.finish()  # type: ignore[no-untyped-call]


def _shown(message: Any) -> str:
    """A message as text for a terminal, without control characters: an objective may come from anyone."""
    if isinstance(message, Empty):
        return "std_msgs/Empty"
    text = f"{len(message)} bytes" if isinstance(message, bytes) else str(getattr(message, "data", message))
    shown = "".join(letter if letter.isprintable() else "\ufffd" for letter in text[:SHOWN])
    return shown if len(text) <= SHOWN else f"{shown}…"
