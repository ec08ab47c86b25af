"""The services of an agent: its jobs, its account on the chain, and messages that it signs or publishes for others.

Anybody on the router can call them. Reading is open to all. What signs, spends or publishes in the agent's name
(`schemas.rpc.GUARDED`) is refused unless the setting `open_services` allows it. Services that drive jobs are refused
in the same way if the agent has handlers, which do its jobs; without handlers they are the only way to do them, as in
the legacy stack. A router with access control can keep strangers away from all of them.
"""

from __future__ import annotations

import logging
import secrets
from typing import TYPE_CHECKING, Any, TypeVar

from msgspec.structs import replace

from mesh.agent.errors import ServiceClosed
from mesh.errors import InputError
from mesh.log_context import log_event
from mesh.work.phases import WrongPhase
from schemas import (
    Demand,
    Offer,
    Result,
    SignedMessage,
    message_hash,
    names_in,
    parse_address,
    resolve_names,
    verify_message,
)
from schemas.message_requests import Published
from schemas.rpc import (
    GUARDED,
    Accounts,
    Allowance,
    Balance,
    BlockNumber,
    Done,
    LiabilityRead,
    Nothing,
    Transaction,
)

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from mesh.agent.components import AgentComponents
    from mesh.work.executor import Executor
    from schemas import Record
    from schemas.message_requests import SendDemand, SendOffer, SendResult, SignDemand, SignOffer, SignResult
    from schemas.rpc import (
        AccountBalance,
        AccountToAddressAllowance,
        Approve,
        FinishLiability,
        ReadLiability,
        RestartLiability,
        ResumeLiability,
        StartLiability,
        TransferFromRequest,
        TransferRequest,
    )

    Service = Callable[[Any], Awaitable[Record]]

log = logging.getLogger(__name__)

M = TypeVar("M", bound=SignedMessage)

DRIVING = frozenset({"start", "restart", "resume", "finish"})
"""The services that drive jobs."""


def offer_services(parts: AgentComponents, executor: Executor, *, has_handlers: bool) -> None:
    """Offer all services of an agent; `has_handlers` if its own code does the jobs."""
    services = {
        **job_services(executor),
        **balance_services(parts),
        **allowance_services(parts),
        **spending_services(parts),
        **MessageServices(parts).services(),
    }
    refused = GUARDED | (DRIVING if has_handlers else frozenset())
    if parts.settings.open_services:
        refused = frozenset()
        facts = log_event("services-opened", address=parts.signer.address)
        log.warning("open_services: anyone on the router may sign and spend with %s", parts.signer.address, extra=facts)
    for name, service in services.items():
        if name in DRIVING and not parts.settings.enable_executor:
            continue
        parts.services.offer(name, _refusal(name) if name in refused else service)


def _refusal(name: str) -> Service:
    async def refuse(_request: Record) -> Record:
        raise ServiceClosed(name)

    return refuse


def job_services(executor: Executor) -> dict[str, Service]:
    """`start`, `finish`, `restart`, `resume` and `read`."""

    async def read(request: ReadLiability) -> LiabilityRead:
        try:
            return LiabilityRead(True, await executor.read(parse_address(request.address)))
        except WrongPhase:
            return LiabilityRead(False)

    async def start(request: StartLiability) -> Done:
        return await _done(executor.start(parse_address(request.address)))

    async def restart(request: RestartLiability) -> Done:
        return await _done(executor.restart(parse_address(request.address)))

    async def resume(request: ResumeLiability) -> Done:
        return await _done(executor.resume(parse_address(request.address)))

    async def finish(request: FinishLiability) -> Nothing:
        await executor.finish(parse_address(request.address), success=request.success)
        return Nothing()

    return {"read": read, "start": start, "restart": restart, "resume": resume, "finish": finish}


async def _done(work: Awaitable[object]) -> Done:
    """Whether a job service could do its work."""
    try:
        await work
    except WrongPhase as error:
        return Done(False, str(error))
    return Done(True)


def balance_services(parts: AgentComponents) -> dict[str, Service]:
    """`eth/…`: the account, the head, and what accounts have. Errors of the chain go to the caller.

    Accounts are addresses or ENS names. Ether is in wei. Tokens are those of the setting `erc20_token`, also for
    services with `xrt` in their names, as in the legacy stack.
    """
    chain, tokens = parts.chain, parts.chain.tokens
    account, token = parts.signer.address, parts.settings.erc20_token

    async def accounts(_request: Nothing) -> Accounts:
        return Accounts((account,))

    async def current_block(_request: Nothing) -> BlockNumber:
        return BlockNumber(await chain.block_number())

    async def account_eth_balance(request: AccountBalance) -> Balance:
        return Balance(await tokens.eth_balance(request.account))

    async def eth_balance(_request: Nothing) -> Balance:
        return Balance(await tokens.eth_balance(account))

    async def account_xrt_balance(request: AccountBalance) -> Balance:
        return Balance(await tokens.balance(request.account, token=token))

    async def xrt_balance(_request: Nothing) -> Balance:
        return Balance(await tokens.balance(account, token=token))

    return {
        "eth/accounts": accounts,
        "eth/current_block": current_block,
        "eth/account_eth_balance": account_eth_balance,
        "eth/eth_balance": eth_balance,
        "eth/account_xrt_balance": account_xrt_balance,
        "eth/xrt_balance": xrt_balance,
    }


def allowance_services(parts: AgentComponents) -> dict[str, Service]:
    """`eth/…`: what one account may take of another's tokens, and the factory of the agent's."""
    chain, account, token = parts.chain, parts.signer.address, parts.settings.erc20_token

    async def account_xrt_allowance(request: AccountToAddressAllowance) -> Allowance:
        return Allowance(await chain.tokens.allowance(request.account, request.to, token=token))

    async def xrt_allowance(_request: Nothing) -> Allowance:
        return Allowance(await chain.tokens.allowance(account, chain.factory, token=token))

    return {"eth/account_xrt_allowance": account_xrt_allowance, "eth/xrt_allowance": xrt_allowance}


def spending_services(parts: AgentComponents) -> dict[str, Service]:
    """`eth/…`: transactions of the agent's account with its token. They are answered once they are mined."""
    tokens, token = parts.chain.tokens, parts.settings.erc20_token

    async def transfer(request: TransferRequest) -> Transaction:
        return Transaction(await tokens.transfer(request.to, int(request.value), token=token))

    async def transfer_from(request: TransferFromRequest) -> Transaction:
        return Transaction(await tokens.transfer_from(request.owner, request.to, int(request.value), token=token))

    async def approve(request: Approve) -> Transaction:
        return Transaction(await tokens.approve(request.spender, int(request.value), token=token))

    return {"eth/transfer": transfer, "eth/transfer_from": transfer_from, "eth/approve": approve}


class MessageServices:
    """`sign/…` and `send/…`, of `demand`, `offer` and `result`.

    What is signed here is resent until it has its effect; what came signed is sent once. No allowance is approved: that
    is what `eth/approve` is for. Orders must be for the agent's own lighthouse, with a deadline after the last block
    that it handled. In generation 5, which counts an account's orders, only one of several that are signed before one
    of them is taken can become a contract.
    """

    def __init__(self, parts: AgentComponents) -> None:
        self._parts = parts
        self._chain = parts.chain

    def services(self) -> dict[str, Service]:
        """The services by name."""
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
        order = await self._resolved(request.unsigned(**await self._nonce_and_sender()))
        await self._check(order)
        return await self._post(self._parts.signer.sign(order))

    async def sign_result(self, request: SignResult) -> Published:
        """Sign a Result. It is sent until its liability has ended, or once if it names no liability."""
        result = await self._resolved(request.unsigned())
        signed = self._parts.signer.sign(result)
        liabilities = self._chain.liabilities
        is_open = await liabilities.exists(signed.liability)
        if is_open and not (await liabilities.get(signed.liability)).is_finalized:
            return await self._post(signed)
        return self._publish(signed)

    async def send(self, request: SendDemand | SendOffer | SendResult) -> Published:
        """Publish a message with a valid signature. Raises `InvalidMessage`, `InputError`."""
        message = await self._resolved(request.message())
        verify_message(message)
        await self._check(message)
        return self._publish(message)

    async def _nonce_and_sender(self) -> dict[str, Any]:
        if self._parts.settings.generation == 3:
            return {"nonce": secrets.token_hex(32), "sender": None}
        address = self._parts.signer.address
        return {"nonce": await self._chain.liabilities.next_nonce(address), "sender": address}

    async def _resolved(self, message: M) -> M:
        return resolve_names(message, {name: await self._chain.names.address(name) for name in names_in(message)})

    async def _check(self, message: SignedMessage) -> None:
        if isinstance(message, Result):
            return
        channel, head = self._parts.channel, self._parts.chain_head.head
        if message.lighthouse != channel.address:
            raise InputError(
                f"this agent trades on {channel.address} ({channel.lighthouse}), the order is for {message.lighthouse}",
                hint="name the agent's lighthouse, or ask an agent of the other",
            )
        if message.deadline <= head:
            raise InputError(
                f"the order's deadline is block {message.deadline}, but the chain is at block {head} already",
                hint="give it a later deadline",
            )
        if isinstance(message, Demand | Offer):
            await self._chain.validators.check(message)

    async def _post(self, signed: SignedMessage) -> Published:
        await self._parts.outbox.post(signed)
        return Published(message_hash(signed).hex())

    def _publish(self, signed: SignedMessage) -> Published:
        self._parts.channel.publish(signed)
        return Published(message_hash(signed).hex())
