"""The names of a device and of its topics in the mesh."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mesh.errors import InputError
from schemas.key_chunks import topic_chunks
from schemas.keys import DeviceTopicKey, LiabilityTopicKey
from schemas.selectors import topic_selector

if TYPE_CHECKING:
    from collections.abc import Iterable

PRESENT: Final = "/present"
"""The topic of the liveliness token, which exists as long as the board answers."""
ABOUT: Final = "/about"
"""The topic on which the edge agent reports which device it serves."""
LOG: Final = "/log"
"""The topic on which the edge agent answers as the service `logs` does."""
CONNECTION: Final = "/aira/device"
"""The topic of a job, followed by the device's name, that records when the device was absent and present."""


@dataclass(frozen=True, kw_only=True)
class DeviceId:
    """A board in the mesh: its agent's address, and a name."""

    agent: str
    name: str

    def key(self, topic: str) -> str:
        """The key of a topic outside any job. Raises `InvalidKey`."""
        return str(DeviceTopicKey(self.agent, self.name, topic))

    def job_key(self, liability: str, topic: str) -> str:
        """The key of a topic of the job at `liability` (address), which all devices of the agent share."""
        return str(LiabilityTopicKey(self.agent, liability, topic))

    def command_keys(self, topic: str) -> tuple[str, str]:
        """The keys of a topic outside any job and in every job: puts and queries there are for the device."""
        return self.key(topic), topic_selector(self.agent, topic=topic)

    def connection_key(self, liability: str) -> str:
        """The key on which a job's recording gets the device's losses and returns."""
        return self.job_key(liability, f"{CONNECTION}/{self.name}")


class TopicNames:
    """Maps a board's topics to their names in the mesh; `renamed` are pairs of the board's name and the mesh's.

    A pair also renames all topics below it, and `/` stands for all topics: `("/", "/left")` maps `/led` to `/left/led`.
    If several pairs match, the longest one applies. Raises `InvalidKey` for a text that is no topic, and `InputError`
    for one that is renamed twice.
    """

    def __init__(self, renamed: Iterable[tuple[str, str]] = ()) -> None:
        self._renamed: dict[str, str] = {}
        for name, other in renamed:
            prefix = _prefix(name)
            if prefix in self._renamed:
                raise InputError(f"{name} is given two names")
            self._renamed[prefix] = _prefix(other)

    def of(self, name: str) -> str:
        """The name in the mesh of the board's topic `name`."""
        prefix = name
        while True:
            if prefix in self._renamed:
                return self._renamed[prefix] + name[len(prefix) :] or name
            if not prefix:
                return name
            prefix = prefix.rpartition("/")[0]


def _prefix(name: str) -> str:
    """The beginning of the names of a topic and of all topics below it; empty for `/`."""
    return "" if name == "/" else topic_chunks(name)
