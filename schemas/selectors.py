"""Selectors: key expressions with wildcards, for subscribers and queries. `schemas.keys` has the keys.

Each function raises `InvalidKey` for a text that is not valid in a key.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from schemas.agent_keys import address_chunk, cid_chunk, name_chunk, topic_chunks
from schemas.errors import InvalidKey
from schemas.keys import lighthouse_chunk
from schemas.message_fields import hex_digits

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from schemas.keys import MarketKind

ORDER: Final = "order"
"""The parameter of a query for the withdrawals of one order."""
LIABILITY: Final = "liability"
"""The parameter of a query for the reports on one liability."""

_SUBJECTS: Final[Mapping[str, Callable[[str], str] | None]] = MappingProxyType(
    {
        "demand": cid_chunk,
        "offer": cid_chunk,
        "withdrawal": None,
        "result": None,
        "feedback": None,
        "pending": None,
        "reject": address_chunk,
        "decline": address_chunk,
        "report": address_chunk,
    }
)
"""The check of the chunk behind each kind of message; None where there is no such chunk."""


def market_selector(lighthouse: str, kind: MarketKind, subject: str = "*") -> str:
    """All messages of a kind on a lighthouse, or those of one subject.

    The subject is the model of a demand or offer, the maker (an address) of what is rejected or declined, or a party of
    the liability that a report is on. Other kinds have none.
    """
    if kind not in _SUBJECTS:
        raise InvalidKey(kind, f"it is not one of the kinds {', '.join(_SUBJECTS)}")
    check, base = _SUBJECTS[kind], f"aira/{lighthouse_chunk(lighthouse)}/{kind}"
    if check is not None:
        return f"{base}/{_any_or(check, subject)}"
    if subject != "*":
        raise InvalidKey(subject, f"the key of a {kind} has no such part")
    return base


def withdrawal_selector(lighthouse: str, order: str) -> str:
    """For a query: the withdrawals of the order with this hash (64 hexadecimal digits)."""
    if hex_digits(order, 32) != order:
        raise InvalidKey(order, "a hash is 64 hexadecimal digits in lower case, without 0x")
    return f"{market_selector(lighthouse, 'withdrawal')}?{ORDER}={order}"


def report_selector(lighthouse: str, party: str, liability: str) -> str:
    """For a query: the validators' reports on a liability, one of whose parties is `party`; both are addresses."""
    return f"{market_selector(lighthouse, 'report', party)}?{LIABILITY}={address_chunk(liability)}"


def lighthouse_selector(lighthouse: str) -> str:
    """All messages on a lighthouse's market; presence tokens are not matched by wildcards."""
    return f"aira/{lighthouse_chunk(lighthouse)}/**"


def presence_selector(lighthouse: str, role: str = "*", agent: str = "*") -> str:
    """The presence tokens of all agents on a lighthouse, or of those in one role, or of one agent."""
    return f"aira/{lighthouse_chunk(lighthouse)}/@agent/{_any_or(name_chunk, role)}/{_any_or(address_chunk, agent)}"


def event_selector(agent: str = "*", liability: str = "*") -> str:
    """The events of an agent's liability and the progress of its playback; by default of all agents and liabilities."""
    return f"aira/agent/{_any_or(address_chunk, agent)}/liability/{_any_or(address_chunk, liability)}/*"


def objective_selector(agent: str, liability: str = "*") -> str:
    """All topics of the objective of a liability of an agent, or of any of its liabilities."""
    return f"aira/agent/{address_chunk(agent)}/liability/{_any_or(address_chunk, liability)}/objective/**"


def topic_selector(agent: str, liability: str = "*", topic: str = "/**") -> str:
    """The topics that a device publishes for one liability of an agent or for any: all of them, or one."""
    of_topic = topic if topic == "/**" else topic_chunks(topic)
    return f"aira/agent/{address_chunk(agent)}/liability/{_any_or(address_chunk, liability)}/topic{of_topic}"


def device_selector(agent: str, device: str = "*") -> str:
    """All topics outside any job of one device of an agent, or of all its devices."""
    return f"aira/agent/{address_chunk(agent)}/device/{_any_or(name_chunk, device)}/**"


def any_topic_selector(agent: str, topic: str) -> str:
    """A topic of an agent's devices and jobs. Other keys of the agent that end in it are matched, too."""
    return f"aira/agent/{address_chunk(agent)}/*/*/**{topic_chunks(topic)}"


def reading_selector(agent: str = "*", topic: str = "/**") -> str:
    """What an agent, or any, publishes outside any job: on all topics, or on one."""
    of_topic = topic if topic == "/**" else topic_chunks(topic)
    return f"aira/agent/{_any_or(address_chunk, agent)}/reading{of_topic}"


def cid_selector(agent: str = "*", cid: str = "*") -> str:
    """A block or a file in the store of one agent or of any; or all that an agent's store has."""
    return f"aira/agent/{_any_or(address_chunk, agent)}/cid/{_any_or(cid_chunk, cid)}"


def requested_cid(selector: str) -> str | None:
    """The CID of the one block that a query of `cid_selector` requests; None if it has a wildcard there."""
    match selector.split("/"):
        case ["aira", "agent", _, "cid", cid]:
            try:
                return cid_chunk(cid)
            except InvalidKey:
                return None
    return None


def _any_or(check: Callable[[str], str], text: str) -> str:
    """The wildcard for one chunk, or a checked chunk."""
    return text if text == "*" else check(text)
