"""Samples that are no messages of the market: providers' rejections, and what agents say of their jobs.

A rejection is signed by its provider. An event is not signed at all: what is checked is that it is on a key of the
agent that the contract, as the event has it, names as promisor. A router with a roster lets nobody else write there.
"""

from __future__ import annotations

import threading
from collections import Counter
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeAlias, TypeVar

from mesh.errors import AiraError, InputError
from mesh.network import ValidationStatistics
from schemas import EventKey, Liability, RejectKey, parse_address, parse_cid, parse_key
from schemas.signing import Rejection

if TYPE_CHECKING:
    from collections.abc import Callable

    import zenoh


class JobEvent(NamedTuple):
    """What an agent says of one of its jobs: `event` is `incoming`, `ready`, `complete` or `finalized`."""

    agent: str
    """Its address, EIP-55."""
    event: str
    liability: Liability


Claim: TypeAlias = Rejection | JobEvent
C = TypeVar("C", bound=Claim)


class Reader(Generic[C]):
    """Reads samples for a pump, and counts under `reason` those that are not what they should be."""

    def __init__(self, read: Callable[[str, bytes], C], *, reason: str) -> None:
        self._read = read
        self._reason = reason
        self._lock = threading.Lock()
        self._refused: Counter[str] = Counter()
        self._accepted = 0

    def __call__(self, sample: zenoh.Sample) -> C | None:
        """The claim in a sample; None for one that is refused."""
        try:
            claim = self._read(str(sample.key_expr), sample.payload.to_bytes())
        except AiraError:
            self.refuse()
            return None
        with self._lock:
            self._accepted += 1
        return claim

    def refuse(self) -> None:
        """Count one that is not believed."""
        with self._lock:
            self._refused[self._reason] += 1

    def statistics(self, *, received: int, dropped: int) -> ValidationStatistics:
        """What was read, given what came and what was lost before."""
        with self._lock:
            refused = dict(self._refused)
            return ValidationStatistics(
                received=received, accepted=self._accepted, invalid=refused, duplicate=0, dropped=dropped
            )


def read_rejection(key: str, payload: bytes) -> Rejection:
    """A provider's rejection, on its own key and signed by it. Raises branches of `AiraError`."""
    rejection, place = Rejection.decode(payload), parse_key(key)
    if not isinstance(place, RejectKey) or str(RejectKey(place.lighthouse, rejection.order, rejection.provider)) != key:
        raise InputError("the rejection is on the key of another")
    if not rejection.is_signed:
        raise InputError("the rejection is not signed by its provider")
    return rejection


def read_event(key: str, payload: bytes) -> JobEvent:
    """What an agent says of its own job. Raises branches of `AiraError`."""
    liability, place = Liability.decode(payload), parse_key(key)
    if not isinstance(place, EventKey):
        raise InputError("this is no key of an event")
    for address in (liability.promisee, liability.promisor, liability.lighthouse, liability.token, liability.validator):
        parse_address(address)
    for cid in (liability.model, liability.objective, *([liability.result] if liability.result else [])):
        parse_cid(cid)
    if place.agent != liability.promisor.lower() or place.liability != liability.address.lower():
        raise InputError("the event is on the key of another")
    return JobEvent(parse_address(place.agent), place.event, liability)
