"""A lighthouse's channel: the market's messages, published, and received verified from subscriptions.

Zenoh keeps no messages. The providers' order books do, and answer queries with the open orders: subscribe first and
then call `Subscription.recall`, and you miss nothing.
"""

from __future__ import annotations

import asyncio
import logging
from contextvars import copy_context
from typing import TYPE_CHECKING, Any, Self

import zenoh

from mesh.errors import ClosedError, InputError, InvalidKey
from mesh.network import sending
from mesh.network.pump import call_in_loop
from mesh.network.subscription import RECALL_LIMIT, RECALL_TIMEOUT, Subscription
from mesh.network.validation import M, MessageValidator, message_key
from schemas import SignedMessage, encode
from schemas.keys import PresenceKey, parse_key
from schemas.selectors import lighthouse_selector, market_selector, presence_selector

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator

    from mesh.blocklist import BlockedSigners
    from mesh.flood import Drops
    from mesh.network.lookups import ValidatorCheck

    Resolver = Callable[[str], Awaitable[str]]

log = logging.getLogger(__name__)


class Channel:
    """The channel of one lighthouse on an open session: `async with Channel(session, lighthouse) as channel`.

    `lighthouse` is the ENS name of the market. `address`, if given, is the lighthouse that orders must name;
    `resolver` resolves ENS names in messages; `validators` knows which validators orders may name (None: any); `head`
    returns the latest block number, for deadlines; messages of `blocked` signers are rejected; what is dropped is
    counted in `drops`. Leaving `async with` withdraws the presence tokens and ends the watches; the caller closes the
    session. Raises `InvalidKey` for a name that no key may contain.
    """

    def __init__(
        self,
        session: zenoh.Session,
        lighthouse: str,
        *,
        address: str | None = None,
        resolver: Resolver | None = None,
        validators: ValidatorCheck | None = None,
        head: Callable[[], int] = lambda: 0,
        blocked: BlockedSigners = frozenset(),
        drops: Drops | None = None,
    ) -> None:
        self._session = session
        self.lighthouse = lighthouse.lower()
        lighthouse_selector(self.lighthouse)  # raises InvalidKey
        self.address = address
        self._resolver = resolver
        self._validators = validators
        self._head = head
        self._blocked = blocked
        self._drops = drops
        self._declarations: list[Any] = []
        self._open = False

    async def __aenter__(self) -> Self:
        if self._open:
            raise ClosedError("this channel is already open")
        self._open = True
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        self._open = False
        declarations, self._declarations = self._declarations, []
        if not self._session.is_closed():
            for declaration in declarations:
                declaration.undeclare()

    def publish(self, message: SignedMessage) -> str:
        """Put a signed message on its key, at most once and without waiting; return the key.

        Delivery is not confirmed: send a message that must arrive again until its effect is seen. Raises `InputError`
        for a message without a signature.
        """
        self._check_open()
        if not message.signature:
            raise InputError("an unsigned message can't be published", hint="sign it first")
        key = message_key(self.lighthouse, message)
        self.put(key, encode(message))
        return key

    def put(self, key: str, payload: bytes) -> None:
        """Put bytes on a key of the mesh. A congested link drops them rather than block.

        Raises `InvalidKey` for a key with a wildcard, which would reach every subscriber.
        """
        self._check_open()
        if "*" in key:
            raise InvalidKey(key, "it contains a wildcard")
        sending.put(self._session, key, payload)

    def subscribe(self, kind: type[M], *, model: str = "*") -> Subscription[M]:
        """Subscribe to the verified messages of `kind` (`Demand`, `Offer`, `Withdrawal` or `Result`).

        `model` (CIDv0) limits orders to that model; the network filters at the source.
        """
        self._check_open()
        selector = market_selector(self.lighthouse, kind.kind, model)
        validator: MessageValidator[M] = MessageValidator(
            kind,
            lighthouse=self.lighthouse,
            address=self.address,
            head=self._head,
            resolver=self._resolver,
            validators=self._validators,
            blocked=self._blocked,
        )
        return Subscription(self._session, selector, validator, drops=self._drops)

    def announce(self, role: str, address: str) -> None:
        """Announce the agent at `address` as present in `role`, for as long as the channel is open."""
        self._check_open()
        key = str(PresenceKey(self.lighthouse, role, address))
        self._declarations.append(self._session.liveliness().declare_token(key))

    def watch_presence(
        self,
        appeared: Callable[[PresenceKey], object],
        *,
        gone: Callable[[PresenceKey], object] = lambda key: None,
        role: str | None = None,
    ) -> None:
        """Call `appeared` for each announced agent, those of now included, and `gone` when one leaves.

        `role` limits this to agents in that role, such as `provider`. The callbacks run in the event loop, in the
        caller's context, until the channel closes. An agent whose link to its router broke is gone, too, and appears
        again when the link is restored.
        """
        self._check_open()
        loop, context = asyncio.get_running_loop(), copy_context()

        def changed(sample: zenoh.Sample) -> None:
            for key in _presence_keys([str(sample.key_expr)]):
                if role is None or key.role == role:
                    notify = appeared if sample.kind == zenoh.SampleKind.PUT else gone
                    call_in_loop(loop, notify, key, context=context)

        selector = presence_selector(self.lighthouse)
        self._declarations.append(self._session.liveliness().declare_subscriber(selector, changed, history=True))

    async def present(self) -> list[PresenceKey]:
        """The agents that are announced on the channel now: role and address, in the order of their keys."""
        self._check_open()
        return await asyncio.to_thread(self._present)

    def _present(self) -> list[PresenceKey]:
        handler: zenoh.handlers.FifoChannel[zenoh.Reply] = zenoh.handlers.FifoChannel(RECALL_LIMIT)
        replies = self._session.liveliness().get(presence_selector(self.lighthouse), handler, timeout=RECALL_TIMEOUT)
        texts = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
        return list(_presence_keys(sorted(texts)))

    def _check_open(self) -> None:
        if not self._open:
            raise ClosedError("the channel is not open", hint="use it inside `async with`")


def _presence_keys(texts: list[str]) -> Iterator[PresenceKey]:
    """The valid keys among `texts`: anybody may declare a token on any key."""
    for text in texts:
        try:
            key = parse_key(text)
        except InvalidKey as error:
            log.debug("ignored a presence token: %s", error)
            continue
        if isinstance(key, PresenceKey):
            yield key
