"""The demo's own objective: a lamp that is to blink three times."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from mcap.writer import Writer

from schemas import EMPTY

if TYPE_CHECKING:
    from pathlib import Path

TOPIC: Final = "/blink"
TIMES: Final = 3
PAUSE_NS: Final = 400_000_000


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
