"""The events of the factory, the lighthouses, the liabilities and the token, and their decoding from logs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, TypeAlias, TypeVar

from mesh.chain.answers import InvalidAnswer, SpoiledAnswer, decode_values
from mesh.chain.artifacts import load_artifact, signature_of
from schemas import keccak256
from schemas.address import ZERO_ADDRESS
from schemas.cid import format_cid
from schemas.errors import InvalidCid

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from mesh.chain.answers import Log


E = TypeVar("E")

LONGEST_NAME: Final = 255
"""Characters of a lighthouse's name; the original factories take any text."""


@dataclass(frozen=True, slots=True)
class NewLiability:
    """A liability was created."""

    liability: str
    tx: str


@dataclass(frozen=True, slots=True)
class Finalized:
    """A liability was finalized. `result` is a CID, empty when it was refunded."""

    liability: str
    success: bool
    result: str
    tx: str


@dataclass(frozen=True, slots=True)
class NewLighthouse:
    """A lighthouse was created; `name` is its label."""

    lighthouse: str
    name: str
    tx: str


@dataclass(frozen=True, slots=True)
class Transfer:
    """Tokens were transferred: XRT (`value` in wn) or the followed token. The zero address mints and burns."""

    sender: str
    recipient: str
    value: int
    tx: str


@dataclass(frozen=True, slots=True)
class Approval:
    """An owner allowed a spender to take up to `value` of its tokens: XRT (wn) or the followed token."""

    owner: str
    spender: str
    value: int
    tx: str


@dataclass(frozen=True, slots=True)
class Online:
    """A provider staked on a lighthouse, and takes part in its turns from now on."""

    lighthouse: str
    provider: str
    tx: str


@dataclass(frozen=True, slots=True)
class Offline:
    """A provider withdrew its stake from a lighthouse."""

    lighthouse: str
    provider: str
    tx: str


@dataclass(frozen=True, slots=True)
class Current:
    """A provider has the turn on a lighthouse, with `quota` transactions left."""

    lighthouse: str
    provider: str
    quota: int
    tx: str


EVENT_CLASSES: Final[Mapping[str, type[ChainEvent]]] = MappingProxyType(
    {
        kind.__name__: kind
        for kind in (NewLiability, Finalized, NewLighthouse, Transfer, Approval, Online, Offline, Current)
    }
)
"""By name, as a saved history has them."""

ChainEvent: TypeAlias = NewLiability | Finalized | NewLighthouse | Transfer | Approval | Online | Offline | Current


def decode_log(log: Log) -> ChainEvent | None:
    """The event in a log; None for a log of other contracts that only looks similar."""
    entry = _layouts().get(log.topics[0]) if log.topics else None
    if entry is None:
        return None
    name, indexed, plain = entry
    if len(log.topics) != 1 + len(indexed):
        return None
    try:
        keys = [decode_values([kind], topic)[0] for kind, topic in zip(indexed, log.topics[1:], strict=True)]
        values = decode_values(plain, _padded(log.data) if plain == ["string"] else log.data)
        return _event(name, log.address, (*keys, *values), "0x" + log.transaction_hash.hex())
    except (SpoiledAnswer, InvalidCid):
        return None


def _padded(data: bytes) -> bytes:
    """The data padded to whole words: the original factory of generation 3 does not pad its string."""
    return data + bytes(-len(data) % 32)


@cache
def topics_of(*contracts: str) -> tuple[str, ...]:
    """The topics (0x…) of the events of these contracts (keys of `EVENTS`)."""
    names = {name for contract in contracts for name in EVENTS[contract]}
    return tuple("0x" + topic.hex() for topic, layout in _layouts().items() if layout[0] in names)


def lighthouse_created(logs: Iterable[Log]) -> NewLighthouse:
    """The lighthouse that a transaction created. Raises `InvalidAnswer` if its logs don't say it."""
    return _first((decode_log(log) for log in logs), NewLighthouse)


def liability_created(logs: Iterable[Log], *, factory: str) -> NewLiability:
    """The liability that a transaction created. Other contracts, such as tokens, may log the same event.

    Raises `InvalidAnswer` if the logs don't say it.
    """
    return _first((decode_log(log) for log in logs if log.address == factory), NewLiability)


def xrt_minted(logs: Iterable[Log], *, xrt: str, account: str) -> int:
    """The XRT (wn) that a transaction minted for an account. Other tokens may log the same event."""
    transfers = (decode_log(log) for log in logs if log.address == xrt)
    return sum(
        transfer.value
        for transfer in transfers
        if isinstance(transfer, Transfer) and (transfer.sender, transfer.recipient) == (ZERO_ADDRESS, account)
    )


def _first(events: Iterable[ChainEvent | None], kind: type[E]) -> E:
    for event in events:
        if isinstance(event, kind):
            return event
    raise InvalidAnswer("the transaction", f"no event {kind.__name__} is in its receipt")


def _event(name: str, emitter: str, values: tuple[Any, ...], tx: str) -> ChainEvent | None:
    """The event; None for a lighthouse whose name can't be a label."""
    match name, values:
        case "NewLiability", (liability,):
            return NewLiability(liability, tx)
        case "Finalized", (success, result):
            return Finalized(emitter, success, format_cid(result) if result else "", tx)
        case "NewLighthouse", (lighthouse, label) if len(label) <= LONGEST_NAME:
            return NewLighthouse(lighthouse, label, tx)
        case "Transfer", (sender, recipient, value):
            return Transfer(sender, recipient, value, tx)
        case "Approval", (owner, spender, value):
            return Approval(owner, spender, value, tx)
        case "Online", (provider,):
            return Online(emitter, provider, tx)
        case "Offline", (provider,):
            return Offline(emitter, provider, tx)
        case "Current", (provider, quota):
            return Current(emitter, provider, quota, tx)
    return None


EVENTS: Final = {
    "Factory": ("NewLiability", "NewLighthouse"),
    "Liability": ("Finalized",),
    "XRT": ("Transfer", "Approval"),
    "Lighthouse": ("Online", "Offline", "Current"),
}


@cache
def _layouts() -> dict[bytes, tuple[str, list[str], list[str]]]:
    """The name and the types of the indexed and the other members of each of `EVENTS`, by topic."""
    layouts = {}
    for contract, names in EVENTS.items():
        for entry in load_artifact(contract).abi:
            if entry["type"] == "event" and entry["name"] in names:
                indexed = [member["type"] for member in entry["inputs"] if member["indexed"]]
                plain = [member["type"] for member in entry["inputs"] if not member["indexed"]]
                layouts[keccak256(signature_of(entry).encode())] = (entry["name"], indexed, plain)
    return layouts
