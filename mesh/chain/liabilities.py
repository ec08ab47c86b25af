"""Liabilities: creating, reading, finalizing and watching them. `chain.liabilities`."""

from __future__ import annotations

import asyncio
from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from itertools import compress
from typing import TYPE_CHECKING

from msgspec.structs import replace

from mesh.chain._contracts import result_arguments
from mesh.chain._node import NODE_LIMITS, getters
from mesh.chain._permits import permit_arguments
from mesh.chain._tokens import Holding
from mesh.chain.answers import LIABILITY_GETTERS, liability_record
from mesh.chain.errors import NoContracts, NodeUnreachable, NotALiability, OrderAlreadyUsed, RequestRefused, Reverted
from mesh.chain.following import (
    EventSources,
    Finalized,
    NewLiability,
    Transfer,
    decode_log,
    first_event,
    list_blocks,
    list_created,
    read_created,
    read_events,
    retrying,
    xrt_minted,
)
from mesh.chain.rpc import is_answered
from mesh.errors import InvalidMessage
from schemas.messages import cancellation_hash, message_hash, order_abi
from schemas.signing import recover

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from mesh.chain._abi import ContractCall
    from mesh.chain._contracts import Contracts
    from mesh.chain._node import Node
    from mesh.chain.answers import MinedTransaction
    from mesh.chain.transactions import Receipt
    from schemas.messages import Demand, Offer, Order, Permit, Result
    from schemas.records import Liability


@dataclass(frozen=True, slots=True)
class Created:
    """A liability that a transaction created, its number in the account, its gas, and what that cost in wei."""

    liability: str
    tx: str
    nonce: int
    gas_used: int
    wei: int
    has_permit: bool = False
    """Whether it was created with a permit, so that the promisee has paid the fee for that."""


@dataclass(frozen=True, slots=True)
class Settled:
    """The transaction that ended a liability, the gas that it used, and what that cost in wei.

    `minted` is the XRT (wn) that its sender received for it.
    """

    tx: str
    gas_used: int
    wei: int
    minted: int


@dataclass(frozen=True, slots=True)
class Mined:
    """A transaction that created or ended a liability: its block, and that block's Unix time."""

    tx: str
    block_number: int
    time: int


@dataclass(frozen=True, slots=True)
class Dated:
    """A liability, and when it was created and ended (None: it is open)."""

    liability: Liability
    created: Mined
    ended: Mined | None


@dataclass(frozen=True, slots=True)
class GasPaid:
    """What a transaction cost, wei (None: the node does not say the price of gas), and the account that paid it.

    `received` is what tokens say that others transferred to that account.
    """

    wei: int | None
    payer: str | None
    received: Mapping[Holding, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class RefundState:
    """Whether a liability can be refunded. Blocks are as contracts count them: the last one is `contract_block`."""

    liability: str
    contract_block: int
    refundable_from: int
    """The first block in which anybody may refund it, if it has not ended by then."""
    is_finalized: bool

    @property
    def is_refundable(self) -> bool:
        """Whether a transaction in the next block could refund it."""
        return not self.is_finalized and self.contract_block + 1 >= self.refundable_from


class Liabilities:
    """Liabilities, and the orders that they are created from."""

    def __init__(self, contracts: Contracts) -> None:
        self._contracts, self._node = contracts, contracts.node
        self._names, self._version = contracts.names, contracts.version

    async def exists(self, address: str) -> bool:
        """Whether the factory created the contract at an address."""
        return await self._version.is_liability(address)

    async def next_nonce(self, address: str | None = None, *, block: int | str = "latest") -> int:
        """The nonce that an account's next generation-5 order must have after a block."""
        return await self._version.nonce_of(await self._contracts.address_or_own(address), block=block)

    async def is_order_used(self, order_hash: bytes, signer: str) -> bool:
        """Whether a generation-3 order of `signer` (address) was used or withdrawn; generation 5 uses nonces."""
        return await self._version.is_order_used(order_hash, signer)

    async def is_used(self, order: Order, *, order_hash: bytes, signer: str) -> bool:
        """Whether an order has become a liability, or was withdrawn on the chain."""
        if order.generation == 3:
            return await self.is_order_used(order_hash, signer)
        return await self.next_nonce(signer) > int(order.nonce)

    async def get_with_orders(self, address: str) -> tuple[Liability, tuple[bytes, bytes]]:
        """The same as `get`, and the hashes of the demand and of the offer that it was created from."""
        return (await _read_all(self._node, [await self._recognised(address)]))[0]

    async def get_all_with_orders(self, addresses: Sequence[str]) -> list[tuple[Liability, tuple[bytes, bytes]]]:
        """The same for several liabilities, six or more of them in one call."""
        recognised = [await self._recognised(address) for address in addresses]
        return await _read_all(self._node, recognised)

    async def find_all(self, addresses: Sequence[str]) -> dict[str, Liability]:
        """The records of those among these addresses that are liabilities, in few calls."""
        found = list(compress(addresses, await self._version.are_liabilities(addresses)))
        return {record.address: record for record, _ in await _read_all(self._node, found)}

    async def find_open(self, addresses: Sequence[str]) -> dict[str, Liability]:
        """The records of those among these addresses that are liabilities and have not ended, in few calls."""
        found = list(compress(addresses, await self._version.are_liabilities(addresses)))
        calls = [call for address in found for call in getters("Liability", address, ("isFinalized",))]
        ended = await self._node.read_all(calls, block="latest")
        still_open = [address for address, has_ended in zip(found, ended, strict=True) if not has_ended]
        return {record.address: record for record, _ in await _read_all(self._node, still_open)}

    async def parties(self, addresses: Sequence[str]) -> list[tuple[str, str]]:
        """Promisee and promisor of each of these, which are known to be liabilities, in one call for fifty."""
        calls = [call for address in addresses for call in getters("Liability", address, ("promisee", "promisor"))]
        found = await self._node.read_all(calls, block="latest")
        return list(zip(found[::2], found[1::2], strict=True))

    async def get(self, address: str) -> Liability:
        """The record of a liability. Raises `NotALiability` unless the factory created it."""
        return (await self.get_with_orders(address))[0]

    async def list(
        self, *, from_block: int = 0, promisee: str = "", promisor: str = "", lighthouse: str = ""
    ) -> Sequence[Liability]:
        """The liabilities created since a block, in order; only those of a promisee, promisor, lighthouse if given."""
        wanted = {"promisee": promisee, "promisor": promisor}
        filters = {getter: await self._names.address(whose) for getter, whose in wanted.items() if whose}
        if lighthouse:
            filters["lighthouse"] = await self._names.lighthouse(lighthouse)
        events = await list_created(self._node, self._contracts.factory, from_block)
        made = [event.liability for event in events if isinstance(event, NewLiability)]
        found = await self._records(made)
        return [one for one in found if all(getattr(one, name) == whose for name, whose in filters.items())]

    async def history(self, *, from_block: int = 0, party: str = "") -> Sequence[Dated]:
        """The liabilities that were created or have ended since a block, with the times of both, by their creation.

        Only those of which `party` (an address) is promisee or promisor, if given.
        """
        sources = EventSources(factory=self._contracts.factory, token="", version=self._version)
        made: dict[str, tuple[str, int]] = {}
        ended: dict[str, tuple[str, int]] = {}
        for block in await list_blocks(self._node, partial(read_events, self._node, sources), from_block):
            for event in block.events:
                if isinstance(event, NewLiability):
                    made[event.liability] = event.tx, block.block_number
                elif isinstance(event, Finalized):
                    ended[event.liability] = event.tx, block.block_number
        records = [one for one in await self._records([*made, *(set(ended) - set(made))]) if _concerns(one, party)]
        missing = {one.address for one in records} - set(made)
        made |= await self._created_before(from_block, missing)
        blocks = {step[1] for one in records for step in (made[one.address], ended.get(one.address)) if step}
        times = await self._times(sorted(blocks))

        def mined(step: tuple[str, int]) -> Mined:
            return Mined(*step, times[step[1]])

        dated = []
        for one in records:
            end = ended.get(one.address)
            # A contract may have ended after the events were read.
            record = one if end else replace(one, is_finalized=False, is_success=False, result="")
            dated.append(Dated(record, mined(made[one.address]), mined(end) if end else None))
        return sorted(dated, key=lambda one: one.created.block_number)

    async def gas_of(self, transactions: Iterable[str]) -> dict[str, GasPaid]:
        """What each of some mined transactions paid for gas."""
        found = {}
        wanted = list(dict.fromkeys(transactions))
        for start in range(0, len(wanted), NODE_LIMITS.requests):
            some = wanted[start : start + NODE_LIMITS.requests]
            for tx, receipt in zip(some, await asyncio.gather(*map(self._node.receipt, some)), strict=True):
                found[tx] = GasPaid(None, None) if receipt is None else _gas_paid(receipt)
        return found

    async def _created_before(self, block: int, wanted: set[str]) -> dict[str, tuple[str, int]]:
        """The transaction and the block of each of these liabilities, which were created before a block.

        They are looked for backwards, in longer and longer ranges: most are a short while old when they end.
        """
        found: dict[str, tuple[str, int]] = {}
        read, span = partial(read_created, self._node, self._contracts.factory), self._node.profile.log_range
        while block > 0 and len(found) < len(wanted):
            first = max(0, block - span)
            for seen in await list_blocks(self._node, read, first, block - 1):
                for event in seen.events:
                    if isinstance(event, NewLiability) and event.liability in wanted:
                        found[event.liability] = event.tx, seen.block_number
            block, span = first, 2 * span
        if len(found) < len(wanted):
            raise NodeUnreachable(self._node.endpoint, "it lacks the events of contracts that it has")
        return found

    async def _times(self, numbers: Sequence[int]) -> dict[int, int]:
        """The Unix times of some blocks."""
        times: dict[int, int] = {}
        for start in range(0, len(numbers), NODE_LIMITS.requests):
            some = numbers[start : start + NODE_LIMITS.requests]
            for header in await asyncio.gather(*map(self._node.header, some)):
                if header is not None:
                    times[header.number] = header.timestamp
        if len(times) < len(numbers):
            raise NodeUnreachable(self._node.endpoint, "it lacks blocks whose events it has")
        return times

    async def _records(self, addresses: Sequence[str]) -> Sequence[Liability]:
        """The records of liabilities that the factory's events name, without those that were reverted since."""
        for address in addresses:
            self._version.recognise(address)
        found, size = [], 60  # in ten calls
        for start in range(0, len(addresses), size):
            found += [record for record, _ in await self.read_existing(addresses[start : start + size])]
        return found

    async def outcomes(self, *, blocks: int, most: int) -> dict[str, tuple[int, int]]:
        """How many contracts paid each promisor (by address), and how many were refunded.

        Counted are those that have ended of the `most` latest ones that were created in the last `blocks` blocks.
        """
        head = await self._node.block_number()
        events = await list_created(self._node, self._contracts.factory, max(0, head - blocks + 1))
        made = [event.liability for event in events if isinstance(event, NewLiability)][-most:]
        names = ("promisor", "isFinalized", "isSuccess")
        calls = [call for address in made for call in getters("Liability", address, names)]
        values = iter(await self._node.read_all(calls, block="latest"))
        found: dict[str, tuple[int, int]] = {}
        for promisor, is_finalized, is_success in zip(values, values, values, strict=True):
            if is_finalized:
                paid, refunded = found.get(promisor, (0, 0))
                found[promisor] = (paid + 1, refunded) if is_success else (paid, refunded + 1)
        return found

    async def read_existing(self, addresses: Sequence[str]) -> Sequence[tuple[Liability, tuple[bytes, bytes]]]:
        """As `get_all_with_orders`, of addresses from events, without those that a reorganisation has reverted."""
        try:
            return await _read_all(self._node, addresses)
        except NoContracts:
            some = [await self.read_existing([address]) for address in addresses] if len(addresses) > 1 else []
            return [one for found in some for one in found]

    async def watch(self, address: str) -> Liability:
        """Wait until a liability has ended; its record then.

        The end must be in a block that counts (`Timing.finality`). Outages of the node are survived, except at the
        start. Raises `NotALiability`, `NodeUnreachable`.
        """
        address = await self._recognised(address)
        while True:
            record = await retrying(self._node, partial(self._ended, address))
            if record is not None:
                return record
            await asyncio.sleep(self._node.timing.poll_interval)

    async def create(self, lighthouse: str, demand: Demand, offer: Offer, *, permit: Permit | None = None) -> Created:
        """Create a liability from two signed orders, as a provider of the lighthouse; perhaps with the maker's permit.

        With the permit the provider earns the demand's `permit_fee`, in the demand's token.

        Raises `InvalidMessage` for an unsigned order or one with a name that is not resolved.
        """
        for order in (demand, offer):
            self._version.check_order(order)
        functions = await self._contracts.lighthouse_contract(lighthouse)
        orders = order_abi(demand), order_abi(offer)
        receipt = await self._contracts.send(
            functions.createLiability(*orders)
            if permit is None
            else functions.createLiabilityWithPermit(*orders, *permit_arguments(permit))
        )
        made = first_event(receipt.logs, NewLiability, emitter=self._contracts.factory)
        self._version.recognise(made.liability)
        has_permit = permit is not None
        return Created(made.liability, receipt.tx, receipt.nonce, receipt.gas_used, receipt.wei, has_permit)

    async def data_gas(self, demand: Demand, offer: Offer) -> int:
        """The gas for whose price the data of a contract's two transactions goes to Ethereum, on OP-type rollups."""
        finalization = b"\1" * 130  # bytes of its data, about, without zeros
        return await self._node.data_gas(order_abi(demand) + order_abi(offer) + finalization)

    async def usual_data_gas(self) -> int:
        """The same for a contract whose orders are not known yet, with a permit."""
        return await self._node.data_gas(b"\1" * 660)  # bytes of both transactions, about, without zeros

    async def withdraw(self, order: Order) -> Receipt:
        """Make a signed order of one's own unusable on the chain, for every provider.

        In generation 5 it uses up the account's nonce, so all orders with this nonce are withdrawn. Raises
        `OrderAlreadyUsed` if the order has become a liability or was withdrawn; `NotOffered`; `InvalidMessage`
        (`sender`) for another account's order; `Reverted` (`WrongNonce`) for a nonce that is not the next one yet.
        """
        digest = message_hash(order)
        signer, own = recover(digest, order.signature), self._contracts.own_address
        if signer != own:
            raise InvalidMessage("sender", f"the order is signed by {signer}, and this account is {own}")
        factory = self._version.ours("withdrawal of orders")
        try:
            return await self._contracts.send(
                factory.withdrawNonce(int(order.nonce)) if order.generation == 5 else factory.withdrawOrder(digest)
            )
        except Reverted as error:
            match error.reason, *error.arguments:
                case ("WrongNonce", int(given), int(following)) if given > following:
                    raise
                case ("OrderUsed" | "WrongNonce", *_):
                    raise OrderAlreadyUsed(digest.hex()) from error
            raise

    async def finalize(self, lighthouse: str, result: Result, *others: Result) -> Settled:
        """Finalize a liability by its signed result, as a provider; `others` are the same, signed by more jurors."""
        functions = await self._contracts.lighthouse_contract(lighthouse)
        return await self._settle(self._version.finalization(functions, result, *others))

    async def finalize_without_turn(self, result: Result, *others: Result) -> Settled:
        """Finalize a liability as `finalize` does, as any account, when no provider does; nothing is minted.

        Raises `NotOffered` for the original contracts, `Reverted` (`WrongSigner`, `AlreadyFinalized`, …).
        """
        return await self._settle(
            self._version.ours("finalization without a turn").finalize(
                result.liability, *result_arguments(result, *others)
            )
        )

    async def validate(self, result: Result, *, agree: bool) -> Settled:
        """Finalize a generation-3 liability as the validator that it names.

        Without `agree` the promisee is paid back, as for a result without success. Raises `NotOffered` for that on the
        original contracts, which would pay the promisor.
        """
        return await self._settle(self._version.validation(result, agree=agree))

    async def cancel(
        self, liability: str, *, promisee_signature: str | bytes, promisor_signature: str | bytes
    ) -> Settled:
        """End a liability without a result, by the signatures of both parties; anybody may send it.

        Each party signs `schemas.cancellation_hash(liability)` with `Signer.sign_hash`: 65 bytes, or their hexadecimal
        digits. The promisee gets everything back. Raises `InvalidMessage` for an invalid signature, `NotALiability`,
        `NotOffered`, `Reverted` (`WrongSigner`, `AlreadyFinalized`).
        """
        address = await self._names.address(liability)
        signatures = [_signature_bytes(address, given) for given in (promisee_signature, promisor_signature)]
        return await self._settle(
            self._version.ours("cancellation").cancel(await self._recognised(address), *signatures)
        )

    async def refund_state(self, liability: str) -> RefundState:
        """Whether a liability can be refunded, and from which block on. Raises `NotALiability`, `NotOffered`."""
        address = await self._recognised(liability)
        block = await self._node.block_number()
        return RefundState(
            liability=address,
            contract_block=await self._node.contract_blocks.last(block),
            refundable_from=await self.refundable_from(address),
            is_finalized=await self._is_finalized(address, block),
        )

    async def refundable_from(self, liability: str) -> int:
        """The first block in which anybody may refund a liability, unless it is finalized. Raises `NotOffered`."""
        self._version.ours("refund")
        functions = self._node.contract("Liability", liability)
        return int(await self._node.read(functions.refundableFrom()))

    async def refund(self, liability: str) -> Settled:
        """Pay back the promisee of a liability that was never finalized."""
        return await self._settle(self._version.ours("refund").refund(liability))

    async def owed(self, token: str, account: str | None = None) -> int:
        """Units of a token that it refused to pay to an account (one's own by default).

        The factory keeps them until they are claimed. XRT refuses nobody.
        """
        token = await self._names.address(token)
        if token == self._contracts.xrt:
            return 0
        return await self._version.owed(token, await self._contracts.address_or_own(account))

    async def owed_after(self, liability: Liability) -> int:
        """Units of its token that whom a liability's end should have paid is owed now, by this one and others."""
        if not liability.is_finalized or not liability.cost:
            return 0
        return await self.owed(liability.token, cost_receiver(liability))

    async def claim(self, token: str, account: str | None = None, *, to: str | None = None) -> Receipt:
        """Pay an account (one's own by default) all that it is owed in a token; anybody may.

        `to` is another account that receives it, for a token that still refuses one's own. Raises `Reverted`
        (`NothingOwed`, or as the token does), `NotOffered`, `ValueError` for `to` with another account.
        """
        token, factory = await self._names.address(token), self._version.ours("claims")
        account = await self._contracts.address_or_own(account)
        if to is None:
            return await self._contracts.send(factory.claim(token, account))
        if account != self._contracts.own_address:
            raise ValueError("only an account itself can have what it is owed paid to another one")
        return await self._contracts.send(factory.claimTo(token, await self._names.address(to)))

    async def _settle(self, call: ContractCall) -> Settled:
        receipt = await self._contracts.send(call)
        minted = xrt_minted(receipt.logs, xrt=self._contracts.xrt, account=self._contracts.own_address)
        return Settled(receipt.tx, receipt.gas_used, receipt.wei, minted)

    async def _recognised(self, address: str) -> str:
        address = await self._names.address(address)
        if not await self.exists(address):
            raise NotALiability(address)
        return address

    async def _ended(self, address: str) -> Liability | None:
        """The record of a liability if its end counts."""
        block = await self._node.counted(await self._node.block_number())
        try:
            if block < 0 or not await self._is_finalized(address, block):
                return None
            return (await _read_all(self._node, [address], block=block))[0][0]
        except NoContracts:  # not created yet in that block
            return None
        except (RequestRefused, NodeUnreachable) as error:
            if self._node.timing.finality == "latest" or not is_answered(error):
                raise
            return await self._ended_by_now(address)

    async def _ended_by_now(self, address: str) -> Liability | None:
        """The same from a node that keeps no state of blocks as old as the final ones: wait for the one that has it."""
        head = await self._node.heads.look()
        record = (await _read_all(self._node, [address], block=head.number))[0][0]
        if not record.is_finalized:
            return None
        await self._node.until_counts(head.number)
        return record if await self._node.block_hash(head.number) == head.hash else None

    async def _is_finalized(self, address: str, block: int) -> bool:
        functions = self._node.contract("Liability", address)
        return bool(await self._node.read(functions.isFinalized(), block=block))


def _concerns(liability: Liability, party: str) -> bool:
    return not party or party in (liability.promisee, liability.promisor)


def _gas_paid(receipt: MinedTransaction) -> GasPaid:
    received: Counter[Holding] = Counter()
    for log in receipt.logs:
        event = decode_log(log)
        if isinstance(event, Transfer) and event.recipient == receipt.sender != event.sender:
            received[Holding(log.address, event.sender)] += event.value
    return GasPaid(receipt.wei(), receipt.sender, received)


def cost_receiver(liability: Liability) -> str:
    """The address that a liability's end pays the cost to."""
    return liability.promisor if liability.is_success else liability.promisee


async def _read_all(
    node: Node, addresses: Sequence[str], *, block: int | str = "latest"
) -> list[tuple[Liability, tuple[bytes, bytes]]]:
    """The records of addresses that are known to be liabilities, and the hashes of their demands and offers."""
    calls = [call for address in addresses for call in getters("Liability", address, LIABILITY_GETTERS)]
    values = await node.read_all(calls, block=block)
    found = []
    for number, address in enumerate(addresses):
        held = dict(zip(LIABILITY_GETTERS, values[number * len(LIABILITY_GETTERS) :], strict=False))
        found.append((liability_record(address, held), (held["demandHash"], held["offerHash"])))
    return found


def _signature_bytes(liability: str, given: str | bytes) -> bytes:
    """The bytes of a signature. Raises `InvalidMessage` if it is invalid."""
    recover(cancellation_hash(liability), given)
    return bytes.fromhex(given.removeprefix("0x")) if isinstance(given, str) else bytes(given)
