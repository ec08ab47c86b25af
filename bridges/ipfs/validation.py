"""Validation of relayed messages, whichever side they come from; the chain data it needs; the legacy JSON encoding."""

from __future__ import annotations

import asyncio
import logging
from hashlib import sha256
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from mesh.errors import AiraError, ChainError, InvalidMessage
from mesh.log_context import log_event
from mesh.market.withdrawals import Withdrawals
from mesh.outage_log import OutageLog
from mesh.retry import REMOTE, Backoff, RetryPolicy
from schemas import (
    ZERO_ADDRESS,
    Demand,
    Message,
    Offer,
    OrderFeedback,
    Result,
    SignedMessage,
    TransactionFeedback,
    Withdrawal,
    address_bytes,
    decode,
    encode,
    names_in,
    recover,
    resolve_names,
    verify_message,
)
from schemas.keys import market_key, market_kind

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from contextlib import AbstractAsyncContextManager

    from mesh.blocklist import BlockedSigners
    from mesh.chain import Chain

    Resolver = Callable[[str], Awaitable[str]]

log = logging.getLogger(__name__)

FINGERPRINT_BYTES: Final = 16
_ENCODER: Final = msgspec.json.Encoder()
_LEGACY_FIELDS: Final[dict[tuple[type[Message], int], tuple[tuple[str, str], ...]]] = {}
"""Kind and generation → (attribute, field on the wire), in the order in which legacy clients wrote them."""


def _legacy_order(kind: type[Message], generation: int, names: str) -> None:
    attributes = {field.encode_name: field.name for field in msgspec.structs.fields(kind)}
    _LEGACY_FIELDS[kind, generation] = tuple((attributes[name], name) for name in names.split())


_legacy_order(Demand, 3, "model objective token cost validator lighthouse deadline nonce signature validatorFee")
_legacy_order(Offer, 3, "model objective token cost validator lighthouse deadline nonce signature lighthouseFee")
_legacy_order(Demand, 5, "model objective token cost lighthouse validator validatorFee deadline sender nonce signature")
_legacy_order(Offer, 5, "model objective token cost validator lighthouse lighthouseFee deadline sender nonce signature")
_legacy_order(Result, 0, "liability result success signature")
_legacy_order(OrderFeedback, 0, "order accepted signature")


def legacy_json(message: Message) -> bytes:
    """The JSON of a message byte for byte as legacy clients wrote it: compact, with the fields in their order.

    Readers should not depend on the order, but some may. Raises `InvalidMessage` (`signature`) for an unsigned message
    of a signed kind.
    """
    generation = message.generation if isinstance(message, Demand | Offer) else 0
    fields = _LEGACY_FIELDS.get((type(message), generation), (("tx", "tx"),))
    if not getattr(message, "signature", "transaction feedback is unsigned"):
        raise InvalidMessage("signature", "the message is not signed")
    return _ENCODER.encode({name: getattr(message, attribute) for attribute, name in fields})


class RelayMessage(NamedTuple):
    """A valid message. Its fingerprint is the same on both sides, whatever the encoding.

    `key` and `payload` are for the mesh, `legacy` is the JSON for IPFS. `hash` is the message's hash if it is signed:
    64 hexadecimal digits, else empty.
    """

    fingerprint: bytes
    key: str
    payload: bytes
    legacy: bytes
    hash: str

    @property
    def kind(self) -> str:
        """The kind in its key: demand, offer, result, feedback or pending."""
        return market_kind(self.key)


class RelayValidator:
    """Validates the messages of one lighthouse (ENS name): `await validator.validate(payload)`.

    `address` returns the address that orders must name as their lighthouse, None while it isn't known; `resolver`
    resolves ENS names in messages; `is_safe` says whether orders may name a validator (address); `head` returns the
    latest block number, or 0 while it isn't known (then no deadline is checked); `withdrawals` are those known;
    messages of `blocked` signers are not relayed.
    """

    def __init__(
        self,
        lighthouse: str,
        *,
        address: Callable[[], str | None] = lambda: None,
        resolver: Resolver | None = None,
        is_safe: Callable[[str], Awaitable[bool]] | None = None,
        head: Callable[[], int] = lambda: 0,
        withdrawals: Withdrawals | None = None,
        blocked: BlockedSigners = frozenset(),
    ) -> None:
        self.withdrawals: Final = Withdrawals() if withdrawals is None else withdrawals
        self._lighthouse = lighthouse
        self._address = address
        self._resolver = resolver
        self._is_safe = is_safe
        self._blocked = blocked
        self.head: Final = head

    async def validate(self, payload: bytes, *, key: str | None = None) -> RelayMessage:
        """The message in `payload`: well-formed, for this market, before its deadline, correctly signed.

        `key`, if given, must be the one that the message requires. The signature of order feedback is not verified,
        because what it covers is undocumented. Raises only `InvalidMessage`; its `reason` is one of `schemas.decode`,
        or `name`, `lighthouse`, `validator`, `deadline`, `signature`, `sender`, `withdrawn`, `blocked`, `key`, and
        `kind` for a message that the legacy network does not have.
        """
        message = decode(payload)
        if isinstance(message, Withdrawal):
            raise InvalidMessage("kind", "the legacy network has no withdrawals")
        canonical = encode(message)
        own_key = market_key(self._lighthouse, message.kind, message.key_model)
        if key is not None and key != own_key:
            raise InvalidMessage("key", f"the message does not belong on {key}")
        digest = "" if isinstance(message, OrderFeedback | TransactionFeedback) else await self._verified(message)
        fingerprint = sha256(canonical).digest()[:FINGERPRINT_BYTES]
        return RelayMessage(fingerprint, own_key, canonical, legacy_json(message), digest)

    def is_withdrawn(self, message: RelayMessage) -> bool:
        """Whether a message that was valid is an order that is withdrawn now."""
        if not self.withdrawals or message.kind not in ("demand", "offer"):
            return False
        digest, order = bytes.fromhex(message.hash), decode(message.payload)
        assert isinstance(order, Demand | Offer)
        return digest + address_bytes(recover(digest, order.signature)) in self.withdrawals

    async def _verified(self, message: SignedMessage) -> str:
        """The hash of a message that may be relayed. Raises `InvalidMessage`."""
        resolved = await self._resolved(message)
        self._check_order(resolved)
        verified = verify_message(resolved)
        if verified.signer in self._blocked:
            raise InvalidMessage("blocked", f"{verified.signer} is blocked")
        if isinstance(resolved, Demand | Offer):
            if verified.hash + address_bytes(verified.signer) in self.withdrawals:
                raise InvalidMessage("withdrawn", "its maker has withdrawn it")
            await self._check_validator(resolved.validator)
        return verified.hash.hex()

    async def _resolved(self, message: SignedMessage) -> SignedMessage:
        names = names_in(message)
        if not names:
            return message
        if self._resolver is None:
            raise InvalidMessage("name", f"this bridge can't resolve {', '.join(sorted(names))}")
        try:
            return resolve_names(message, {name: await self._resolver(name) for name in names})
        except AiraError as error:
            raise InvalidMessage("name", str(error)) from error

    async def _check_validator(self, validator: str) -> None:
        """An order is not relayed before it is known that its validator is no lighthouse."""
        if validator == ZERO_ADDRESS or self._is_safe is None:
            return
        try:
            is_safe = await self._is_safe(validator)
        except AiraError as error:
            raise InvalidMessage("validator", str(error)) from error
        if not is_safe:
            raise InvalidMessage("validator", f"{validator} is a lighthouse, or could become one")

    def _check_order(self, order: SignedMessage) -> None:
        if isinstance(order, Result):
            return
        if (address := self._address()) is not None and order.lighthouse != address:
            raise InvalidMessage("lighthouse", f"made for {order.lighthouse}, not for this market")
        if (head := self.head()) and order.deadline <= head:
            raise InvalidMessage("deadline", f"block {order.deadline} has passed")


class ChainAwaited(ChainError, code="chain-awaited"):
    """The chain's node was not reached yet."""


class ChainView:
    """What validation needs from the chain: the lighthouses' addresses, ENS names and the latest block.

    `chain` creates an unopened client; `lighthouses` are ENS names; `interval` is in seconds between two reads of the
    latest block. Start `run` as a task. Until the node is reached nothing is known, which is logged once; what was read
    stays known.
    """

    def __init__(
        self,
        chain: Callable[[], AbstractAsyncContextManager[Chain]],
        lighthouses: tuple[str, ...],
        *,
        interval: float,
        retry: RetryPolicy = REMOTE,
    ) -> None:
        self._make_chain = chain
        self._interval = interval
        self._retry = retry
        self._outage = OutageLog(log, "chain")
        self._chain: Chain | None = None
        self._addresses: dict[str, str | None] = dict.fromkeys(lighthouses)
        self.head = 0
        """The latest block number; 0 while it isn't known."""
        self.error = ""
        """The last error, empty while all is well."""

    def address(self, lighthouse: str) -> str | None:
        """The lighthouse's address, None while it isn't known."""
        return self._addresses[lighthouse]

    async def resolve(self, name: str) -> str:
        """The address of an ENS name. Raises `ChainError`."""
        if self._chain is None:
            raise ChainAwaited("the chain's node was not reached yet")
        return await self._chain.names.address(name)

    async def is_safe_validator(self, validator: str) -> bool:
        """Whether orders may name a validator (address). Raises `ChainError`."""
        if self._chain is None:
            raise ChainAwaited("the chain's node was not reached yet")
        return await self._chain.validators.is_safe(validator)

    async def run(self) -> None:
        """Follow the chain until cancelled. Raises `ConfigurationError` for a chain that contradicts the settings."""
        backoff = Backoff(self._retry)
        while True:
            try:
                async with self._make_chain() as self._chain:
                    log.info("the chain's node is reachable", extra=log_event("chain-connected"))
                    backoff.reset()
                    while True:
                        await self._read(self._chain)
                        await asyncio.sleep(self._interval)
            except ChainError as error:
                self._failed(error, "deadlines and ENS names are not checked until the chain's node is reachable")
            finally:
                self._chain = None
            await backoff.wait()

    async def _read(self, chain: Chain) -> None:
        """Read the head and unknown addresses. After an outage of the node, its client reconnects by itself."""
        try:
            self.head = await chain.block_number()
            for name in [name for name, address in self._addresses.items() if address is None]:
                self._addresses[name] = await chain.names.address(name)
        except ChainError as error:
            self._failed(error, "the latest block or a lighthouse's address could not be read")
        else:
            self.error = ""
            self._outage.recovered("deadlines and ENS names are checked")

    def _failed(self, error: ChainError, consequence: str) -> None:
        self._outage.failed(error, consequence)
        self.error = str(error)
