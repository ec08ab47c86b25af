"""The contracts on the chain: ours, which serve both generations at once, or the originals of one generation.

They share most functions. `ContractVersion` and `OriginalContracts` hold the differences: how a result is finalized,
the names of a lighthouse's getters, how a liability is recognised. The versions of the originals are tested against
our contracts, which have both sets of names.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

from mesh.chain.errors import NoAccount, NotOffered, UnknownContracts
from mesh.chain.lighthouse_state import GETTERS, LighthouseState, lighthouse_state, original_state
from mesh.errors import InvalidMessage
from mesh.flood import BoundedDict
from schemas.address import address_bytes
from schemas.cid import parse_cid
from schemas.signing import recover
from schemas.wire import message_hash

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.chain.abi import ContractCall, ContractFunctions
    from mesh.chain.names import Names
    from mesh.chain.node import Node
    from mesh.chain.transactions import Receipt, TransactionSender
    from schemas.messages import Order, Result

ContractKind = Literal["mesh", "original"]
"""Ours, or the legacy ones."""

AGREE: Final = True
"""A provider always agrees with a result; only a validator, who finalizes on its own, can disagree."""

RECOGNISED_LIABILITIES: Final = 65_536
"""Liabilities that are remembered as such; the factory is asked about others."""

GAS_OF: Final = {3: "gasUtilizing", 5: "gasConsumedOf"}


class ContractVersion:
    """Our own contracts. `factory` is the address of the factory; `generation` names the root of its names."""

    def __init__(self, node: Node, factory: str, generation: int) -> None:
        self.generation = generation
        self._node = node
        self._factory = node.contract("Factory", factory)
        self._liabilities: BoundedDict[str, None] = BoundedDict(RECOGNISED_LIABILITIES)

    def check_order(self, order: Order) -> None:
        """Raise `InvalidMessage` for an order that the contracts can't read."""

    def finalization(self, lighthouse: ContractFunctions, result: Result, *others: Result) -> ContractCall:
        """The call by which a provider finalizes a liability with its result, which `others` have signed, too.

        Raises `NotOffered`.
        """
        return lighthouse.finalizeLiability(result.liability, *result_arguments(result, *others))

    def finalization_without_turn(self, result: Result, *others: Result) -> ContractCall:
        """The call by which anybody finalizes a liability, as `finalization`. Raises `NotOffered`."""
        return self._factory.finalize(result.liability, *result_arguments(result, *others))

    def validation(self, result: Result, *, agree: bool) -> ContractCall:
        """The call by which a generation-3 validator finalizes. Raises `NotOffered`."""
        return self._liability(result.liability).finalize(*result_arguments(result), agree)

    def cancellation(self, liability: str, promisee: bytes, promisor: bytes) -> ContractCall:
        """The call that ends a liability by the signatures of both parties. Raises `NotOffered`."""
        return self._factory.cancel(liability, promisee, promisor)

    def withdrawal(self, order: Order) -> ContractCall:
        """The call by which an order's maker makes it unusable. Raises `NotOffered`."""
        if order.generation == 5:
            return self._factory.withdrawNonce(int(order.nonce))
        return self._factory.withdrawOrder(message_hash(order))

    def refund(self, liability: str) -> ContractCall:
        """The call that pays a promisee back. Raises `NotOffered`."""
        return self._factory.refund(liability)

    async def refundable_from(self, liability: str) -> int:
        """The first block in which the refund is possible. Raises `NotOffered`."""
        return int(await self._node.read(self._liability(liability).refundableFrom()))

    async def nonce_of(self, address: str) -> int:
        """The nonce of an account's next generation-5 order. Raises `NotOffered`."""
        return int(await self._node.read(self._factory.nonceOf(address)))

    async def is_order_used(self, order_hash: bytes, signer: str) -> bool:
        """Whether the generation-3 order that `signer` signed has created its liability or was withdrawn."""
        return bool(await self._node.read(self._factory.isOrderUsed(order_hash, signer)))

    def recognise(self, liability: str) -> None:
        """Remember an address as a liability, because the factory named it in an event."""
        self._liabilities[liability] = None  # the factory still knows those that are forgotten

    async def is_liability(self, address: str) -> bool:
        """Whether the factory created the contract at an address."""
        if address not in self._liabilities and await self._node.read(self._created(address)):
            self.recognise(address)
        return address in self._liabilities

    async def are_liabilities(self, addresses: Sequence[str]) -> list[bool]:
        """Whether the factory created the contracts at these addresses, as of the latest block; 100 in one call."""
        return [bool(answer) for answer in await self._node.read_all(map(self._created, addresses), block="latest")]

    async def state(self, lighthouse: str) -> LighthouseState:
        """The state of a lighthouse, as of one block. Raises `NoContracts` if there is none."""
        return await lighthouse_state(self._node, lighthouse)

    async def is_turn(self, lighthouse: str, provider: str) -> bool:
        """Whether a provider may send in the next block."""
        functions = self._node.contract("Lighthouse", lighthouse)
        return bool(await self._node.read(functions.isTurnOf(provider), block="pending"))

    def _created(self, address: str) -> ContractCall:
        """The call that returns neither 0 nor false for a liability of the factory."""
        return self._factory.isLiability(address)

    def _liability(self, address: str) -> ContractFunctions:
        return self._node.contract("Liability", address)


class OriginalContracts(ContractVersion):
    """The original contracts of one generation, which understand the orders of that generation only.

    They give no reasons when they refuse, pay nobody back, and don't say whose liability a contract is: a liability is
    recognised by an event of the factory that names it, or by the gas that the factory has counted for it.
    """

    def check_order(self, order: Order) -> None:
        if order.generation != self.generation:
            raise InvalidMessage(
                reason="generation",
                detail=f"the contracts are of generation {self.generation}, the order of {order.generation}",
            )

    def finalization(self, lighthouse: ContractFunctions, result: Result, *others: Result) -> ContractCall:
        if others:
            raise NotOffered("finalization by several signers", self.generation)
        if self.generation == 5:
            return super().finalization(lighthouse, result)
        call = super().validation(result, agree=AGREE)
        return lighthouse.to(result.liability, call.data)

    def finalization_without_turn(self, result: Result, *others: Result) -> ContractCall:
        raise NotOffered("finalization without a turn", self.generation)

    def validation(self, result: Result, *, agree: bool) -> ContractCall:
        if self.generation == 5:
            raise NotOffered("finalization by a validator's own account", self.generation)
        if result.success and not agree:
            raise NotOffered("refusal by a validator: they would pay the promisor", self.generation)
        return super().validation(result, agree=agree)

    def cancellation(self, liability: str, promisee: bytes, promisor: bytes) -> ContractCall:
        raise NotOffered("cancellation", self.generation)

    def withdrawal(self, order: Order) -> ContractCall:
        raise NotOffered("withdrawal of orders", self.generation)

    def refund(self, liability: str) -> ContractCall:
        raise NotOffered("refund", self.generation)

    async def refundable_from(self, liability: str) -> int:
        raise NotOffered("refund", self.generation)

    async def nonce_of(self, address: str) -> int:
        if self.generation == 3:
            raise NotOffered("nonceOf", self.generation)
        return await super().nonce_of(address)

    async def is_order_used(self, order_hash: bytes, signer: str) -> bool:
        """By any signer: the originals accept the same terms only once, even if another account signs them."""
        return bool(await self._node.read(self._factory.isHashConsumed(order_hash)))

    async def state(self, lighthouse: str) -> LighthouseState:
        return await original_state(self._node, lighthouse, GETTERS[self.generation])

    async def is_turn(self, lighthouse: str, provider: str) -> bool:
        """By the rule of the originals: the provider at the marker, or any provider after a timeout of silence."""
        state = await self.state(lighthouse)
        silence = await self._node.block_number() + 1 - state.keep_alive_block
        return provider in state.stakes and (provider == state.current or silence > state.timeout_blocks)

    async def are_liabilities(self, addresses: Sequence[str]) -> list[bool]:
        counted = await super().are_liabilities(addresses)
        return [found or address in self._liabilities for address, found in zip(addresses, counted, strict=True)]

    def _created(self, address: str) -> ContractCall:
        return self._factory[GAS_OF[self.generation]](address)


def contract_version(kind: ContractKind, node: Node, factory: str, generation: int) -> ContractVersion:
    """The version for a kind and a generation. Raises `UnknownContracts` if there is none."""
    if generation not in GETTERS or kind not in ("mesh", "original"):
        raise UnknownContracts(
            f"there are no {kind} contracts of generation {generation}",
            hint='contracts are "mesh" or "original", generations 3 or 5',
        )
    return (OriginalContracts if kind == "original" else ContractVersion)(node, factory, generation)


def result_arguments(result: Result, *others: Result) -> tuple[bytes, bool, bytes]:
    """A signed result as arguments of the contracts; `others` are the same, signed by others.

    Several signatures are in ascending order of their signers.
    """
    if not others:
        return parse_cid(result.result), result.success, bytes.fromhex(result.signature)
    digest = message_hash(result)
    if any(message_hash(other) != digest for other in others):
        raise InvalidMessage("result", "results with different contents can't finalize a contract together")
    signed = sorted((result, *others), key=lambda one: address_bytes(recover(digest, one.signature)))
    signatures = bytes.fromhex("".join(one.signature for one in signed))
    return parse_cid(result.result), result.success, signatures


@dataclass(frozen=True, slots=True, kw_only=True)
class Contracts:
    """What the parts of an open `Chain` share. `factory` and `xrt` are addresses; `sender` is None for reading only."""

    node: Node
    names: Names
    version: ContractVersion
    factory: str
    xrt: str
    sender: TransactionSender | None

    @property
    def own_address(self) -> str:
        """The address of the account that signs. Raises `NoAccount`."""
        return self.signing().account.address

    def signing(self) -> TransactionSender:
        """The sender of the account's transactions. Raises `NoAccount`."""
        if self.sender is None:
            raise NoAccount
        return self.sender

    async def send(self, call: ContractCall) -> Receipt:
        """Send a call as the account and wait until it is mined. Raises as `TransactionSender.send` does."""
        return await self.signing().call(call)

    async def address_or_own(self, name_or_address: str | None) -> str:
        """The address of a name; the account's own for None."""
        return self.own_address if name_or_address is None else await self.names.address(name_or_address)

    def factory_contract(self) -> ContractFunctions:
        """The factory."""
        return self.node.contract("Factory", self.factory)

    async def lighthouse_contract(self, lighthouse: str) -> ContractFunctions:
        """The lighthouse of that name or address."""
        return self.node.contract("Lighthouse", await self.names.lighthouse(lighthouse))
