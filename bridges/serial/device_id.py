"""What a device is called in the mesh, and the topics that its edge agent has there beside those of the board."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from schemas.keys import DeviceTopicKey, LiabilityTopicKey

PRESENT: Final = "/present"
"""The topic of the token that is there as long as the board is."""
ABOUT: Final = "/about"
"""The topic on which the edge agent answers what device it serves."""
LOG: Final = "/log"
"""The topic that answers as the service `logs` does."""
CABLE: Final = "/aira/device"
"""The topic of a job, with the device's name behind it, on which its recording has when the device went and came."""


@dataclass(frozen=True, kw_only=True)
class DeviceId:
    """What the mesh knows a board by: its agent's address, and a name."""

    agent: str
    name: str

    def key(self, topic: str) -> str:
        """The key of a topic outside any job. Raises `InvalidKey`."""
        return str(DeviceTopicKey(self.agent, self.name, topic))

    def key_of_job(self, liability: str, topic: str) -> str:
        """The key of a topic of the job at `liability` (address), which all of the agent's devices share."""
        return str(LiabilityTopicKey(self.agent, liability, topic))

    def keys_of(self, topic: str) -> tuple[str, str]:
        """The keys of a topic outside any job and in every one: what is put or asked there is for the device."""
        return self.key(topic), f"aira/agent/{self.agent.lower()}/liability/*/topic{topic}"

    def cable(self, liability: str) -> str:
        """The key on which a job's recording has when the device went and came."""
        return self.key_of_job(liability, f"{CABLE}/{self.name}")
