"""Contracts between promisees and promisors: the parts of `Chain` that make, read, end and watch liabilities."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

from mesh.chain.errors import NoContracts, NodeUnreachable, NotALiability, RequestRefused
from mesh.chain.events import NewLiability, liability_created, xrt_minted
from mesh.chain.following import Following
from mesh.chain.records import Created, RefundState, Settled, read_liability
from mesh.trouble import Trouble
from schemas.packing import cancellation_hash, order_abi
from schemas.signing import recover

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.chain.transactions import Receipt
    from schemas.liability import Liability
    from schemas.messages import Demand, Offer, Result

log = logging.getLogger(__name__)

READ_AT_ONCE: Final = 8
"""Records that a listing asks a node for at the same time."""


class Liabilities(Following):
    """Liabilities and the orders that they are made of; a part of `Chain`."""

    async def nonce_of(self, address: str | None = None) -> int:
        """The nonce that an account's next generation-5 order must have."""
        return await self._suite.nonce_of(await self._whose(address))

    async def is_order_used(self, order_hash: bytes, signer: str) -> bool:
        """Whether a generation-3 order of `signer` (address) was used already (generation 5 is told by its nonce)."""
        return await self._suite.is_order_used(order_hash, signer)

    async def liability(self, address: str) -> Liability:
        """The record of a liability. Raises `NotALiability` unless the factory made it."""
        return await read_liability(self.node, await self._recognised(address))

    async def liabilities(
        self, *, from_block: int = 0, promisee: str = "", promisor: str = "", lighthouse: str = ""
    ) -> list[Liability]:
        """The records of the liabilities made since a block, in order; of one promisee, promisor, lighthouse only."""
        wanted = {"promisee": promisee, "promisor": promisor}
        filters = {getter: await self.resolve(whose) for getter, whose in wanted.items() if whose}
        if lighthouse:
            filters["lighthouse"] = await self.lighthouse_address(lighthouse)
        made = [event.liability async for event in self._made(from_block) if isinstance(event, NewLiability)]
        found: list[Liability] = []
        for start in range(0, len(made), READ_AT_ONCE):
            some = made[start : start + READ_AT_ONCE]
            records = await asyncio.gather(*(self._matching(address, filters) for address in some))
            found += [record for record in records if record is not None]
        return found

    async def watch_liability(self, address: str) -> Liability:
        """The record of a liability once it has ended, as its contract has it; waits for that.

        The end counts when it has the node's confirmations (`Timing.confirmations`). A node that is lost meanwhile is
        waited for. Raises `NotALiability`, and `NodeUnreachable` when there is no node at the start.
        """
        address, trouble = await self._recognised(address), Trouble(log)
        while True:
            try:
                record = await self._ended(address)
                trouble.over(f"{address} can be watched again")
            except (NodeUnreachable, RequestRefused) as error:
                trouble.met(error, f"{address} can't be watched, trying again")
                record = None
            if record is not None:
                return record
            await asyncio.sleep(self.node.timing.poll_interval)

    async def order_hashes(self, liability: str) -> tuple[bytes, bytes]:
        """The hashes of the demand and of the offer that a liability was made of."""
        functions = self.node.contract("Liability", liability).functions
        demand_hash = await self.node.read(functions.demandHash())
        return bytes(demand_hash), bytes(await self.node.read(functions.offerHash()))

    async def create_liability(self, lighthouse: str, demand: Demand, offer: Offer) -> Created:
        """Make a liability of two signed orders, as a provider of the lighthouse.

        Raises `InvalidMessage` for an unsigned order or one with a name that is not resolved.
        """
        for order in (demand, offer):
            self._suite.check_order(order)
        functions = (await self._lighthouse(lighthouse)).functions
        receipt = await self._send(functions.createLiability(order_abi(demand), order_abi(offer)))
        made = liability_created(receipt.logs, factory=self.factory)
        created = Created(made.liability, receipt.tx, receipt.gas_used, receipt.wei)
        self._suite.recognise(created.liability)
        return created

    async def finalize(self, lighthouse: str, result: Result) -> Settled:
        """Finalize a liability by its signed result, as a provider of the lighthouse."""
        functions = (await self._lighthouse(lighthouse)).functions
        receipt = await self._send(self._suite.finalization(functions, result))
        return self._settled(receipt)

    async def validate(self, result: Result, *, agree: bool) -> Settled:
        """Finalize a generation-3 liability as the validator that it names.

        Without `agree` the promisee is paid back, as for a result without success.
        """
        receipt = await self._send(self._suite.validation(result, agree=agree))
        return self._settled(receipt)

    async def cancel(
        self, liability: str, *, promisee_signature: str | bytes, promisor_signature: str | bytes
    ) -> Settled:
        """End a liability without a result, as both parties want; anybody may send it.

        Each party signs `schemas.cancellation_hash(liability)` with `Signer.sign_hash`: 65 bytes, or their hexadecimal
        digits. The promisee has everything back. Raises `InvalidMessage` for what is no signature, `NotALiability`,
        `NotOffered`, `Reverted` (`WrongSigner`, `AlreadyFinalized`).
        """
        address = await self.resolve(liability)
        signatures = [_signature_bytes(address, given) for given in (promisee_signature, promisor_signature)]
        call = self._suite.cancellation(await self._recognised(address), *signatures)
        receipt = await self._send(call)
        return self._settled(receipt)

    async def refund_state(self, liability: str) -> RefundState:
        """Whether the promisee can be paid back, and from when on. Raises `NotALiability`, `NotOffered`."""
        address = await self._recognised(liability)
        block = await self.node.block_number()
        return RefundState(
            liability=address,
            block_number=block,
            refundable_from=await self._suite.refundable_from(address),
            is_finalized=await self._is_finalized(address, block),
        )

    async def refundable_from(self, liability: str) -> int:
        """The block from which anyone may have the promisee paid back, if the liability is not finalized by then."""
        return await self._suite.refundable_from(liability)

    async def refund(self, liability: str) -> Settled:
        """Pay back the promisee of a liability that was never finalized."""
        receipt = await self._send(self._suite.refund(liability))
        return self._settled(receipt)

    def _settled(self, receipt: Receipt) -> Settled:
        minted = xrt_minted(receipt.logs, xrt=self.xrt, account=self._signing().account.address)
        return Settled(receipt.tx, receipt.gas_used, receipt.wei, minted)

    async def _recognised(self, address: str) -> str:
        address = await self.resolve(address)
        if not await self.is_liability(address):
            raise NotALiability(address)
        return address

    async def _matching(self, address: str, filters: Mapping[str, str]) -> Liability | None:
        """The record of what the factory made, None for another's, or if a reorganisation has taken it back."""
        self._suite.recognise(address)
        functions = self.node.contract("Liability", address).functions
        try:
            for getter, whose in filters.items():
                if await self.node.read(functions[getter]()) != whose:
                    return None
            return await read_liability(self.node, address)
        except NoContracts:
            return None

    async def _ended(self, address: str) -> Liability | None:
        """The record of a liability whose end is confirmed; None as long as it is not."""
        block = await self.node.block_number() - self.node.timing.confirmations + 1
        try:
            if block < 0 or not await self._is_finalized(address, block):
                return None
            return await read_liability(self.node, address, block=block)
        except NoContracts:  # not made yet in that block
            return None

    async def _is_finalized(self, address: str, block: int) -> bool:
        functions = self.node.contract("Liability", address).functions
        return bool(await self.node.read(functions.isFinalized(), block=block))


def _signature_bytes(liability: str, given: str | bytes) -> bytes:
    """The bytes of a signature that somebody made. Raises `InvalidMessage` if nobody can have."""
    recover(cancellation_hash(liability), given)
    return bytes.fromhex(given.removeprefix("0x")) if isinstance(given, str) else bytes(given)
