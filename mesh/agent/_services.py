"""The services of an agent: its jobs, its account on the chain, and messages that it signs or publishes for others.

Anybody on the router can call them. Reading is open to all. What signs, spends or publishes in the agent's name,
or is its owner's (`schemas.rpc.GUARDED`), is refused unless the setting `open_services` allows it. Services that drive
jobs are refused in the same way if the agent has handlers, which do its jobs; without handlers they are the only way to
do them, as in the legacy stack. A router with access control can keep strangers away from all of them.
"""

from __future__ import annotations

import logging
import secrets
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from msgspec.structs import replace

from mesh.agent.jobs import check_stop
from mesh.agent.ledger import WrongPhase
from mesh.base.log_context import log_event
from mesh.errors import AiraError, InputError, public_text
from schemas import (
    Demand,
    Offer,
    SignedMessage,
    Withdrawal,
    message_hash,
    names_in,
    parse_address,
    resolve_names,
    verify_message,
)
from schemas.rpc import (
    GUARDED,
    Accounts,
    Allowance,
    Balance,
    BlockNumber,
    Done,
    LiabilityRead,
    Nothing,
    Published,
    Stopped,
    Transaction,
)

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from mesh.agent.components import AgentComponents
    from mesh.agent.jobs import Executor
    from schemas import Record
    from schemas.records import DeviceStop
    from schemas.rpc import (
        AccountBalance,
        AccountToAddressAllowance,
        Approve,
        FinishLiability,
        LiabilityRequest,
        SendDemand,
        SendOffer,
        SendResult,
        SignDemand,
        SignOffer,
        SignResult,
        TransferFromRequest,
        TransferRequest,
    )
    from schemas.signing import StopRequest

    Service = Callable[[Any], Awaitable[Record]]

    class Stopping(Protocol):
        """`AgentRuntime.stop`."""

        def __call__(self, address: str, *, why: str, by: str, code: str = "") -> Awaitable[tuple[DeviceStop, ...]]: ...


log = logging.getLogger(__name__)

M = TypeVar("M", bound=SignedMessage)

DRIVING = frozenset({"start", "restart", "resume", "finish"})
"""The services that drive jobs."""


def offer_services(
    parts: AgentComponents, executor: Executor, stop: Stopping, control: Service, *, has_handlers: bool
) -> None:
    """Offer all services of an agent; `has_handlers` if its own code does the jobs, `stop` stops one of them.

    `control` does what its owner wants.
    """
    services = {
        **job_services(executor),
        "stop": stop_service(parts, executor, stop),
        "control": control,
        **account_services(parts),
        **MessageServices(parts).services(),
    }
    refused = GUARDED | (DRIVING if has_handlers else frozenset())
    if parts.settings.open_services:
        refused = frozenset()
        facts = log_event("services-opened", address=parts.signer.address)
        log.warning("open_services: anyone on the router may sign and spend with %s", parts.signer.address, extra=facts)
    for name, service in services.items():
        if name in {*DRIVING, "stop", "control"} and not parts.settings.enable_executor:
            continue
        parts.services.offer(name, _refusal(name) if name in refused else service)


def _refusal(name: str) -> Service:
    async def refuse(_request: Record) -> Record:
        raise AiraError(
            f"this agent does not offer {name} to others",
            hint="set open_services = true on the agent, if only those who may use its account reach its router",
            code="service-closed",
        )

    return refuse


def job_services(executor: Executor) -> dict[str, Service]:
    """`start`, `finish`, `restart`, `resume` and `read`."""

    async def read(request: LiabilityRequest) -> LiabilityRead:
        try:
            return LiabilityRead(True, await executor.read(parse_address(request.address)))
        except WrongPhase:
            return LiabilityRead(False)

    async def finish(request: FinishLiability) -> Nothing:
        await executor.finish(parse_address(request.address), success=request.success)
        return Nothing()

    def done(work: Callable[[str], Awaitable[object]]) -> Service:
        async def call(request: LiabilityRequest) -> Done:
            try:
                await work(parse_address(request.address))
            except WrongPhase as error:
                return Done(False, public_text(error))
            return Done(True)

        return call

    driving = {"start": done(executor.start), "restart": done(executor.restart), "resume": done(executor.resume)}
    return {"read": read, "finish": finish, **driving}


def stop_service(parts: AgentComponents, executor: Executor, stop: Stopping) -> Service:
    """`stop`, for the customer of a job and for the agent's own account, by their signatures.

    Only the own account may give a code: with it, it hands the job back.
    """

    async def stop_job(request: StopRequest) -> Stopped:
        address = parse_address(request.liability)
        try:
            liability = await executor.read(address)
        except WrongPhase:
            hint = "ask again: its contract may be in a block that the agent has not read yet"
            raise AiraError(f"{address} is not a job of this agent", hint=hint, code="busy") from None
        own = parts.signer.address
        may_stop = request.by == own or (request.by == liability.promisee and not request.code)
        if not may_stop or not request.is_signed:
            facts = log_event("stop-refused", liability=address, by=request.by)
            log.warning("refused to stop %s for %s", address, request.by, extra=facts)
            raise AiraError(
                f"{request.by} may not {'hand back' if request.code else 'stop'} {address}",
                hint="its customer may stop it, and the robot's own account may stop it or hand it back",
                code="stop-refused",
            )
        check_stop(request.why, request.code or None)
        return Stopped(await stop(address, why=request.why, by=request.by, code=request.code))

    return stop_job


def account_services(parts: AgentComponents) -> dict[str, Service]:
    """`eth/…`: the account, the head, what accounts have and may take of others', and the agent's transactions.

    Accounts are addresses or ENS names. Ether is in wei. Tokens are those of the setting `erc20_token`, also for
    services with `xrt` in their names, as in the legacy stack. Transactions are answered once they are mined. Errors of
    the chain go to the caller.
    """
    chain, tokens = parts.chain, parts.chain.tokens
    own, token = parts.signer.address, parts.settings.erc20_token

    def account_of(request: AccountBalance | AccountToAddressAllowance | Nothing) -> str:
        return own if isinstance(request, Nothing) else request.account

    async def accounts(_request: Nothing) -> Accounts:
        return Accounts((own,))

    async def current_block(_request: Nothing) -> BlockNumber:
        return BlockNumber(await chain.contract_block())  # deadlines count it

    async def eth_balance(request: AccountBalance | Nothing) -> Balance:
        return Balance(await tokens.eth_balance(account_of(request)))

    async def xrt_balance(request: AccountBalance | Nothing) -> Balance:
        return Balance(await tokens.balance(account_of(request), token=token))

    async def xrt_allowance(request: AccountToAddressAllowance | Nothing) -> Allowance:
        spender = chain.factory if isinstance(request, Nothing) else request.to
        return Allowance(await tokens.allowance(account_of(request), spender, token=token))

    async def transfer(request: TransferRequest) -> Transaction:
        return Transaction(await tokens.transfer(request.to, int(request.value), token=token))

    async def transfer_from(request: TransferFromRequest) -> Transaction:
        return Transaction(await tokens.transfer_from(request.owner, request.to, int(request.value), token=token))

    async def approve(request: Approve) -> Transaction:
        return Transaction(await tokens.approve(request.spender, int(request.value), token=token))

    return {
        "eth/accounts": accounts,
        "eth/current_block": current_block,
        "eth/account_eth_balance": eth_balance,
        "eth/eth_balance": eth_balance,
        "eth/account_xrt_balance": xrt_balance,
        "eth/xrt_balance": xrt_balance,
        "eth/account_xrt_allowance": xrt_allowance,
        "eth/xrt_allowance": xrt_allowance,
        "eth/transfer": transfer,
        "eth/transfer_from": transfer_from,
        "eth/approve": approve,
    }


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
        if self._parts.settings.generation == 3:
            order = await self._resolved(request.unsigned(nonce=secrets.token_hex(32), sender=None))
        else:
            sender = self._parts.signer.address
            nonce = await self._chain.liabilities.next_nonce(sender)
            order = await self._resolved(request.unsigned(nonce=nonce, sender=sender))
        await self._check(order)
        signed = self._parts.signer.sign(order)
        await self._parts.outbox.post(signed)
        return Published(message_hash(signed).hex())

    async def sign_result(self, request: SignResult) -> Published:
        """Sign a Result. It is sent until its liability has ended, or once if it names no liability."""
        result = await self._resolved(request.unsigned())
        signed = self._parts.signer.sign(result)
        liabilities = self._chain.liabilities
        is_open = await liabilities.exists(signed.liability)
        if is_open and not (await liabilities.get(signed.liability)).is_finalized:
            await self._parts.outbox.post(signed)
        else:
            self._parts.channel.publish(signed)
        return Published(message_hash(signed).hex())

    async def send(self, request: SendDemand | SendOffer | SendResult) -> Published:
        """Publish a message with a valid signature. Raises `InvalidMessage`, `InputError`."""
        message = await self._resolved(request.message())
        verify_message(message)
        await self._check(message)
        self._parts.channel.publish(message)
        return Published(message_hash(message).hex())

    async def _resolved(self, message: M) -> M:
        return resolve_names(message, {name: await self._chain.names.address(name) for name in names_in(message)})

    async def _check(self, message: SignedMessage) -> None:
        if not isinstance(message, Demand | Offer | Withdrawal):
            return
        channel, head = self._parts.channel, self._parts.chain_head.contract_block
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
