"""What may cross from one side to the other: everything is checked, whichever side it comes from."""

from __future__ import annotations

from hashlib import sha256
from typing import TYPE_CHECKING, Final, NamedTuple

from bridges.ipfs.writing import legacy_json
from mesh.errors import AiraError, InvalidMessage
from mesh.network.validation import key_of
from schemas import (
    FeedbackKey,
    Message,
    OrderFeedback,
    PendingKey,
    Result,
    SignedMessage,
    TransactionFeedback,
    decode,
    encode,
    keccak256,
    message_hash,
    names_in,
    resolve_names,
    verify_hashed,
)

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    Resolver = Callable[[str], Awaitable[str]]

FINGERPRINT: Final = 16
"""Bytes by which a message is known again."""


class Passenger(NamedTuple):
    """A message that may cross: known again by its fingerprint, whichever way it was written.

    `key` and `payload` are for the mesh, `legacy` is the JSON for IPFS.
    """

    fingerprint: bytes
    key: str
    payload: bytes
    legacy: bytes

    @property
    def kind(self) -> str:
        """What it is, as its key says: demand, offer, result, feedback or pending."""
        return self.key.split("/", 3)[2]


class Gate:
    """The checks of one lighthouse's market: `await gate.admit(payload)`.

    `lighthouse` is the ENS name; `address` tells what must be the orders' lighthouse, None while that isn't known;
    `resolver` looks up the ENS names that messages may hold; `head` tells the latest block, or 0 when it isn't known
    (no deadline is checked).
    """

    def __init__(
        self,
        lighthouse: str,
        *,
        address: Callable[[], str | None] = lambda: None,
        resolver: Resolver | None = None,
        head: Callable[[], int] = lambda: 0,
    ) -> None:
        self._lighthouse = lighthouse
        self._address = address
        self._resolver = resolver
        self._head = head

    async def admit(self, payload: bytes, *, key: str | None = None) -> Passenger:
        """The message in `payload`, if it is one: well-formed, for this market, in time and truly signed.

        `key`, where it came by one, must be its own. What a feedback's signature covers is not documented, so that one
        is not checked. Raises `InvalidMessage` and nothing else; its `reason` is that of `schemas.decode`, or `name`,
        `lighthouse`, `deadline`, `signature`, `sender`, `key`.
        """
        message = decode(payload)
        canonical = encode(message)
        own_key = await self._key(message, canonical)
        if key is not None and not _same(key, own_key, message):
            raise InvalidMessage("key", f"the message does not belong on {key}")
        fingerprint = sha256(canonical).digest()[:FINGERPRINT]
        return Passenger(fingerprint, key or own_key, canonical, legacy_json(message))

    async def _key(self, message: Message, canonical: bytes) -> str:
        match message:
            case OrderFeedback():
                return str(FeedbackKey(self._lighthouse, message.order, keccak256(canonical).hex()))
            case TransactionFeedback():
                return str(PendingKey(self._lighthouse, message.tx))
        resolved = await self._resolved(message)
        self._check_order(resolved)
        digest = message_hash(resolved)
        verify_hashed(resolved, digest)
        return key_of(self._lighthouse, resolved, digest)

    async def _resolved(self, message: SignedMessage) -> SignedMessage:
        names = names_in(message)
        if not names:
            return message
        if self._resolver is None:
            raise InvalidMessage("name", f"nobody here can look up {', '.join(sorted(names))}")
        try:
            return resolve_names(message, {name: await self._resolver(name) for name in names})
        except AiraError as error:
            raise InvalidMessage("name", str(error)) from error

    def _check_order(self, order: SignedMessage) -> None:
        if isinstance(order, Result):
            return
        if (address := self._address()) is not None and order.lighthouse != address:
            raise InvalidMessage("lighthouse", f"made for {order.lighthouse}, not for this market")
        if order.deadline <= self._head():
            raise InvalidMessage("deadline", f"block {order.deadline} has passed")


def _same(key: str, own: str, message: Message) -> bool:
    """A feedback's key ends in what its writer chose to tell several apart; all else in a key follows from content."""
    if isinstance(message, OrderFeedback):
        return key.rpartition("/")[0] == own.rpartition("/")[0]
    return key == own
