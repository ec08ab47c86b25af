"""Liabilities: creating, reading, finalizing and watching them. `chain.liabilities`."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from functools import partial
from itertools import compress
from typing import TYPE_CHECKING, Final

from mesh.chain.answers import LIABILITY_GETTERS, liability_record
from mesh.chain.errors import NoContracts, NotALiability, OrderAlreadyUsed, Reverted
from mesh.chain.events import NewLiability, liability_created, xrt_minted
from mesh.chain.following import retrying
from mesh.chain.multicall import getters
from mesh.chain.reader import list_created
from mesh.errors import InvalidMessage
from schemas.signing import recover
from schemas.wire import cancellation_hash, message_hash, order_abi

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from mesh.chain.abi import ContractCall
    from mesh.chain.contracts import Contracts
    from mesh.chain.node import Node
    from mesh.chain.transactions import Receipt
    from schemas.messages import Demand, Offer, Order, Result
    from schemas.records import Liability

READ_AT_ONCE: Final = 8
"""How many records a listing asks the node for at the same time."""


@dataclass(frozen=True, slots=True)
class Created:
    """A liability that a transaction created, its number in the account, its gas, and what that cost in wei."""

    liability: str
    tx: str
    nonce: int
    gas_used: int
    wei: int


@dataclass(frozen=True, slots=True)
class Settled:
    """The transaction that ended a liability, the gas that it used, and what that cost in wei.

    `minted` is the XRT (wn) that its sender received for it.
    """

    tx: str
    gas_used: int
    wei: int
    minted: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RefundState:
    """Whether a liability can be refunded, as of the block `block_number`."""

    liability: str
    block_number: int
    refundable_from: int
    """The first block in which anybody may refund it, if it has not ended by then."""

    is_finalized: bool

    @property
    def is_refundable(self) -> bool:
        """Whether a transaction in the next block could refund it."""
        return not self.is_finalized and self.block_number + 1 >= self.refundable_from


class Liabilities:
    """Liabilities, and the orders that they are created from."""

    def __init__(self, contracts: Contracts) -> None:
        self._contracts = contracts

    async def exists(self, address: str) -> bool:
        """Whether the factory created the contract at an address."""
        return await self._contracts.version.is_liability(address)

    async def next_nonce(self, address: str | None = None) -> int:
        """The nonce that an account's next generation-5 order must have."""
        return await self._contracts.version.nonce_of(await self._contracts.address_or_own(address))

    async def is_order_used(self, order_hash: bytes, signer: str) -> bool:
        """Whether a generation-3 order of `signer` (address) was used or withdrawn; generation 5 uses nonces."""
        return await self._contracts.version.is_order_used(order_hash, signer)

    async def is_used(self, order: Order, *, order_hash: bytes, signer: str) -> bool:
        """Whether an order has become a liability, or was withdrawn on the chain."""
        if order.generation == 3:
            return await self.is_order_used(order_hash, signer)
        return await self.next_nonce(signer) > int(order.nonce)

    async def get_with_orders(self, address: str) -> tuple[Liability, tuple[bytes, bytes]]:
        """The same as `get`, and the hashes of the demand and of the offer that it was created from."""
        return await _read(self._contracts.node, await self._recognised(address))

    async def get_all_with_orders(self, addresses: Sequence[str]) -> list[tuple[Liability, tuple[bytes, bytes]]]:
        """The same for several liabilities, six or more of them in one call."""
        recognised = [await self._recognised(address) for address in addresses]
        return await _read_all(self._contracts.node, recognised)

    async def find_all(self, addresses: Sequence[str]) -> dict[str, Liability]:
        """The records of those among these addresses that are liabilities, in few calls."""
        found = list(compress(addresses, await self._contracts.version.are_liabilities(addresses)))
        return {record.address: record for record, _ in await _read_all(self._contracts.node, found)}

    async def parties(self, addresses: Sequence[str]) -> list[tuple[str, str]]:
        """Promisee and promisor of each of these, which are known to be liabilities, in one call for fifty."""
        calls = [call for address in addresses for call in getters("Liability", address, ("promisee", "promisor"))]
        found = await self._contracts.node.read_all(calls, block="latest")
        return list(zip(found[::2], found[1::2], strict=True))

    async def get(self, address: str) -> Liability:
        """The record of a liability. Raises `NotALiability` unless the factory created it."""
        return (await self.get_with_orders(address))[0]

    async def list(
        self, *, from_block: int = 0, promisee: str = "", promisor: str = "", lighthouse: str = ""
    ) -> Sequence[Liability]:
        """The liabilities created since a block, in order; only those of a promisee, promisor, lighthouse if given."""
        wanted = {"promisee": promisee, "promisor": promisor}
        filters = {getter: await self._contracts.names.address(whose) for getter, whose in wanted.items() if whose}
        if lighthouse:
            filters["lighthouse"] = await self._contracts.names.lighthouse(lighthouse)
        events = await list_created(self._contracts.node, self._contracts.factory, from_block)
        made = [event.liability for event in events if isinstance(event, NewLiability)]
        found = []
        for start in range(0, len(made), READ_AT_ONCE):
            some = made[start : start + READ_AT_ONCE]
            records = await asyncio.gather(*(self._matching(address, filters) for address in some))
            found += [record for record in records if record is not None]
        return found

    async def watch(self, address: str) -> Liability:
        """Wait until a liability has ended; its record then.

        The end needs `Timing.confirmations`. Outages of the node are survived, except at the start.
        Raises `NotALiability`, `NodeUnreachable`.
        """
        address, node = await self._recognised(address), self._contracts.node
        while True:
            record = await retrying(node, partial(self._ended, address))
            if record is not None:
                return record
            await asyncio.sleep(node.timing.poll_interval)

    async def create(self, lighthouse: str, demand: Demand, offer: Offer) -> Created:
        """Create a liability from two signed orders, as a provider of the lighthouse.

        Raises `InvalidMessage` for an unsigned order or one with a name that is not resolved.
        """
        for order in (demand, offer):
            self._contracts.version.check_order(order)
        functions = await self._contracts.lighthouse_contract(lighthouse)
        receipt = await self._contracts.send(functions.createLiability(order_abi(demand), order_abi(offer)))
        made = liability_created(receipt.logs, factory=self._contracts.factory)
        self._contracts.version.recognise(made.liability)
        return Created(made.liability, receipt.tx, receipt.nonce, receipt.gas_used, receipt.wei)

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
        try:
            return await self._contracts.send(self._contracts.version.withdrawal(order))
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
        return await self._settle(self._contracts.version.finalization(functions, result, *others))

    async def finalize_without_turn(self, result: Result, *others: Result) -> Settled:
        """Finalize a liability as `finalize` does, as any account, when no provider does; nothing is minted.

        Raises `NotOffered` for the original contracts, `Reverted` (`WrongSigner`, `AlreadyFinalized`, …).
        """
        return await self._settle(self._contracts.version.finalization_without_turn(result, *others))

    async def validate(self, result: Result, *, agree: bool) -> Settled:
        """Finalize a generation-3 liability as the validator that it names.

        Without `agree` the promisee is paid back, as for a result without success. Raises `NotOffered` for that on the
        original contracts, which would pay the promisor.
        """
        return await self._settle(self._contracts.version.validation(result, agree=agree))

    async def cancel(
        self, liability: str, *, promisee_signature: str | bytes, promisor_signature: str | bytes
    ) -> Settled:
        """End a liability without a result, by the signatures of both parties; anybody may send it.

        Each party signs `schemas.cancellation_hash(liability)` with `Signer.sign_hash`: 65 bytes, or their hexadecimal
        digits. The promisee gets everything back. Raises `InvalidMessage` for an invalid signature, `NotALiability`,
        `NotOffered`, `Reverted` (`WrongSigner`, `AlreadyFinalized`).
        """
        address = await self._contracts.names.address(liability)
        signatures = [_signature_bytes(address, given) for given in (promisee_signature, promisor_signature)]
        return await self._settle(self._contracts.version.cancellation(await self._recognised(address), *signatures))

    async def refund_state(self, liability: str) -> RefundState:
        """Whether a liability can be refunded, and from which block on. Raises `NotALiability`, `NotOffered`."""
        address = await self._recognised(liability)
        block = await self._contracts.node.block_number()
        return RefundState(
            liability=address,
            block_number=block,
            refundable_from=await self._contracts.version.refundable_from(address),
            is_finalized=await self._is_finalized(address, block),
        )

    async def refundable_from(self, liability: str) -> int:
        """The first block in which anybody may refund a liability, if it is not finalized by then."""
        return await self._contracts.version.refundable_from(liability)

    async def refund(self, liability: str) -> Settled:
        """Pay back the promisee of a liability that was never finalized."""
        return await self._settle(self._contracts.version.refund(liability))

    async def _settle(self, call: ContractCall) -> Settled:
        receipt = await self._contracts.send(call)
        minted = xrt_minted(receipt.logs, xrt=self._contracts.xrt, account=self._contracts.own_address)
        return Settled(receipt.tx, receipt.gas_used, receipt.wei, minted)

    async def _recognised(self, address: str) -> str:
        address = await self._contracts.names.address(address)
        if not await self.exists(address):
            raise NotALiability(address)
        return address

    async def _matching(self, address: str, filters: Mapping[str, str]) -> Liability | None:
        """The record of a liability; None if it does not match the filters, or a reorganisation reverted it."""
        self._contracts.version.recognise(address)
        functions = self._contracts.node.contract("Liability", address)
        try:
            for getter, whose in filters.items():
                if await self._contracts.node.read(functions[getter]()) != whose:
                    return None
            return (await _read(self._contracts.node, address))[0]
        except NoContracts:
            return None

    async def _ended(self, address: str) -> Liability | None:
        """The record of a liability if its end is confirmed."""
        block = await self._contracts.node.block_number() - self._contracts.node.timing.confirmations + 1
        try:
            if block < 0 or not await self._is_finalized(address, block):
                return None
            return (await _read(self._contracts.node, address, block=block))[0]
        except NoContracts:  # not created yet in that block
            return None

    async def _is_finalized(self, address: str, block: int) -> bool:
        functions = self._contracts.node.contract("Liability", address)
        return bool(await self._contracts.node.read(functions.isFinalized(), block=block))


async def _read(node: Node, address: str, *, block: int | str = "latest") -> tuple[Liability, tuple[bytes, bytes]]:
    """As `_read_all`, for one. Raises `NoContracts` for a block before its creation."""
    return (await _read_all(node, [address], block=block))[0]


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
