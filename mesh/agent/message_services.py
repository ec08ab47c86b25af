"""Services that speak on the market: messages that the agent signs, and signed ones that it publishes for others."""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING, Any, TypeVar

from msgspec.structs import replace

from mesh.errors import InputError
from schemas import Result, SignedMessage, message_hash, names_in, resolve_names, verify_message
from schemas.message_requests import Published

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from mesh.agent.components import AgentComponents
    from schemas import Record
    from schemas.message_requests import SendDemand, SendOffer, SendResult, SignDemand, SignOffer, SignResult

M = TypeVar("M", bound=SignedMessage)


class MessageServices:
    """`sign/…` and `send/…`, of `demand`, `offer` and `result`.

    What is signed here is sent again until it has its effect, as everything that the agent says; what came signed is
    sent once. Nothing is approved: `eth/approve` lets the factory take what an order may cost. Orders must be for the
    agent's own lighthouse, and valid at the block that it has seen last. Generation 5 counts an account's orders: of
    several that are signed before one is taken, only one can be.
    """

    def __init__(self, parts: AgentComponents) -> None:
        self._parts = parts
        self._chain = parts.chain

    def answers(self) -> dict[str, Callable[[Any], Awaitable[Record]]]:
        """What is answered, by the name of the service."""
        return {
            "sign/demand": self.sign_order,
            "sign/offer": self.sign_order,
            "sign/result": self.sign_result,
            "send/demand": self.send,
            "send/offer": self.send,
            "send/result": self.send,
        }

    async def sign_order(self, request: SignDemand | SignOffer) -> Published:
        """Sign an order in the settings' generation and post it. Raises `InvalidMessage`, `InputError`."""
        request = replace(request, model=await self._chain.names.model(request.model))
        order = await self._resolved(request.unsigned(**await self._origin()))
        self._check(order)
        return await self._post(self._parts.signer.sign(order))

    async def sign_result(self, request: SignResult) -> Published:
        """Sign a Result; sent until its liability has ended, or once where it answers no liability."""
        result = await self._resolved(request.unsigned())
        signed = self._parts.signer.sign(result)
        is_owed = (
            await self._chain.liabilities.exists(signed.liability)
            and not (await self._chain.liabilities.get(signed.liability)).is_finalized
        )
        return await (self._post(signed) if is_owed else self._publish(signed))

    async def send(self, request: SendDemand | SendOffer | SendResult) -> Published:
        """Publish a message whose signature holds. Raises `InvalidMessage`, `InputError`."""
        message = await self._resolved(request.message())
        verify_message(message)
        self._check(message)
        return await self._publish(message)

    async def _origin(self) -> dict[str, Any]:
        """Nonce and sender of an order of this account's."""
        if self._parts.settings.generation == 3:
            return {"nonce": secrets.token_hex(32), "sender": None}
        address = self._parts.signer.address
        return {"nonce": await self._chain.liabilities.next_nonce(address), "sender": address}

    async def _resolved(self, message: M) -> M:
        return resolve_names(message, {name: await self._chain.names.address(name) for name in names_in(message)})

    def _check(self, message: SignedMessage) -> None:
        if isinstance(message, Result):
            return
        channel, head = self._parts.channel, self._parts.clock.head
        if message.lighthouse != channel.address:
            raise InputError(
                f"this agent trades on {channel.address} ({channel.lighthouse}), the order is for {message.lighthouse}",
                hint="name the agent's lighthouse, or ask an agent of the other",
            )
        if message.deadline <= head:
            raise InputError(
                f"the order's deadline is block {message.deadline}, and block {head} is there already",
                hint="give it a later deadline",
            )

    async def _post(self, signed: SignedMessage) -> Published:
        await self._parts.outbox.post(signed)
        return Published(message_hash(signed).hex())

    async def _publish(self, signed: SignedMessage) -> Published:
        self._parts.channel.publish(signed)
        return Published(message_hash(signed).hex())
