"""Which agents are present on a channel, as asked at a limited rate about those whose statements arrive."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from mesh.flood import KnownSenders, Rate, RateLimiter

if TYPE_CHECKING:
    from mesh.network.channel import Channel

PER_AGENT: Final = Rate(per_second=0.5, burst=4)
"""Questions whether an agent with an unknown address is present."""
QUESTIONS: Final = Rate(per_second=50, burst=500)
"""Such questions in all."""
KNOWN: Final = 65_536
"""Agents that are remembered."""


class PresentAgents:
    """The agents that were found present on `channel`, in a `role` or in any. They are remembered."""

    def __init__(self, channel: Channel, *, role: str = "*") -> None:
        self._channel = channel
        self._role = role
        self._known = KnownSenders(KNOWN)
        self._questions = RateLimiter(per_sender=PER_AGENT, total=QUESTIONS)

    async def is_present(self, agent: str) -> bool:
        """Whether an agent (address) was found present. Who is unknown is asked after, at a limited rate."""
        if agent in self._known:
            return True
        is_present = self._questions.allow(agent) and bool(await self._channel.present(self._role, agent))
        if is_present:
            self._known.add(agent)
        return is_present
