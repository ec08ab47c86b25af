"""Quality of service of ROS 2 endpoints, and its text in liveliness tokens."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, Literal

from bridges.ros2.errors import InvalidRosToken

LARGEST_DEPTH: Final = 10_000
"""Messages that a publisher or subscription of ours keeps, at most."""

_FIELD: Final = re.compile(r"[0-9]{0,20}")
_DEFAULT_DEPTH: Final = 42


@dataclass(frozen=True, slots=True)
class RosQos:
    """How messages are delivered. `depth` is how many messages are kept for `keep-last`.

    `transient-local` publishers keep their last messages for subscriptions that come later.
    """

    depth: int = 10
    reliability: Literal["reliable", "best-effort"] = "reliable"
    durability: Literal["volatile", "transient-local"] = "volatile"
    history: Literal["keep-last", "keep-all"] = "keep-last"

    @property
    def is_transient_local(self) -> bool:
        """Whether late subscriptions receive earlier messages."""
        return self.durability == "transient-local"

    @property
    def kept(self) -> int:
        """How many messages are kept."""
        return LARGEST_DEPTH if self.history == "keep-all" else max(1, min(self.depth, LARGEST_DEPTH))

    def encode(self) -> str:
        """The text in a token of rmw_zenoh, with all values that matter, since versions differ in what is default."""
        reliability = "1" if self.reliability == "reliable" else "2"
        durability = "1" if self.is_transient_local else "2"
        history = "1" if self.history == "keep-last" else "2"
        return f"{reliability}:{durability}:{history},{self.depth}:,:,:,,"


DEFAULT_QOS: Final = RosQos()
"""What a publisher, subscription or service has by default."""
SENSOR_DATA: Final = RosQos(depth=5, reliability="best-effort")
"""What sensors publish with."""
LATCHED: Final = RosQos(depth=1, durability="transient-local")
"""One message for late subscriptions: maps, descriptions, the states of goals."""


def parse_qos(text: str) -> RosQos:
    """The quality of service in a token of rmw_zenoh. Raises `InvalidRosToken`."""
    parts = [part.split(",") for part in text.split(":")]
    if [len(part) for part in parts] != [1, 1, 2, 2, 2, 3]:
        raise InvalidRosToken(text, "its quality of service is not as in 1:2:1,10:,:,:,,")
    if not all(_FIELD.fullmatch(field) for part in parts for field in part):
        raise InvalidRosToken(text, "its quality of service has a field that is no number")
    if parts[5][0] == "2":
        raise InvalidRosToken(text, "it has a kind of liveliness that ROS 2 has given up")
    (reliability,), (durability,), (history, depth) = parts[:3]
    return RosQos(
        int(depth or _DEFAULT_DEPTH),
        "best-effort" if reliability == "2" else "reliable",
        "transient-local" if durability == "1" else "volatile",
        "keep-all" if history == "2" else "keep-last",
    )
