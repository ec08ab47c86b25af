"""The contracts on the chain: ours, which serve both generations at once, or the originals of one generation.

They share most functions. `ContractVersion` and `OriginalContracts` hold the differences: how a result is finalized,
the names of a lighthouse's getters, how a liability is recognised. The versions of the originals are tested against
our contracts, which have both sets of names.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import compress
from typing import TYPE_CHECKING, ClassVar, Final, Literal, NamedTuple

from mesh.base.flood import BoundedDict
from mesh.chain.answers import InvalidAnswer
from mesh.chain.errors import NotOffered
from mesh.errors import ConfigurationError, InvalidMessage
from schemas.address import ZERO_ADDRESS, address_bytes, parse_address
from schemas.cid import parse_cid
from schemas.messages import message_hash
from schemas.signing import recover

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from mesh.chain._abi import ContractCall, ContractFunctions
    from mesh.chain._names import Names
    from mesh.chain._node import Node
    from mesh.chain.transactions import Receipt, TransactionSender
    from schemas.messages import Order, Result


class LighthouseLimits(NamedTuple):
    """How many providers of one lighthouse are read."""

    providers: int = 10_000
    """In all; one with more is not read."""
    page: int = 250
    """That one call of ours returns, at about 5,000 gas each."""


LIGHTHOUSE_LIMITS: Final = LighthouseLimits()


class LighthouseGetters(NamedTuple):
    """The names of a lighthouse's getters, and how its turns are counted."""

    length: str
    at: str
    stake: str
    rules: tuple[str, str, str, str]
    """Minimal stake, timeout, the block of the last transaction, and the quota that is left."""
    first: int
    """The marker of the first provider."""


GETTERS: Final = {
    3: LighthouseGetters(
        "membersLength", "members", "balances", ("minimalFreeze", "timeoutBlocks", "keepaliveBlock", "quota"), first=0
    ),
    5: LighthouseGetters(
        "providersLength",
        "providers",
        "stakes",
        ("minimalStake", "timeoutInBlocks", "keepAliveBlock", "quota"),
        first=1,
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class LighthouseState:
    """The state of a lighthouse. Stakes are wn, `timeout_blocks` and `keep_alive_block` count blocks."""

    address: str
    minimal_stake: int
    timeout_blocks: int
    keep_alive_block: int
    """The block of the last transaction, from which silence counts."""
    quota: int
    """How many transactions are left in the turn."""
    current: str
    """The provider that has the turn; the zero address if there is none."""
    stakes: dict[str, int]
    """Providers and their stakes, in the order of their turns; ours begin with the current one."""


def _state(address: str, rules: list[int], current: str, stakes: dict[str, int]) -> LighthouseState:
    minimal_stake, timeout_blocks, keep_alive_block, quota = rules
    return LighthouseState(
        address=address,
        minimal_stake=minimal_stake,
        timeout_blocks=timeout_blocks,
        keep_alive_block=keep_alive_block,
        quota=quota,
        current=parse_address(current),
        stakes=stakes,
    )


def _paged(stakes: dict[str, int], accounts: list[str], staked: list[int], *, address: str) -> dict[str, int]:
    """The stakes with those of another page. Raises `InvalidAnswer`."""
    paged = stakes | {parse_address(account): stake for account, stake in zip(accounts, staked, strict=False)}
    if len(paged) != len(stakes) + len(accounts) or len(accounts) != len(staked):
        raise InvalidAnswer(f"queue of {address}", "a page with providers twice, or without their stakes")
    _check_count(address, len(paged))
    return paged


def _check_count(address: str, count: int) -> None:
    if count > (most := LIGHTHOUSE_LIMITS.providers):
        raise InvalidAnswer(f"providers of {address}", f"{count} providers, and {most} are read at most")


ContractKind = Literal["mesh", "original"]
"""Ours, or the legacy ones."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ContractNames:
    """Which contracts of a chain are meant."""

    ens: str = ""
    """Address of the ENS registry; empty: the public or a development chain's."""
    generation: int = 3
    """3 or 5: the root under which names are looked up."""
    factory: str = ""
    """Name or address of the factory; empty: that of the generation."""
    xrt: str = ""
    """The same of the token XRT."""
    kind: ContractKind = "mesh"
    """This project's, which read both generations of orders, or the originals of the generation."""
    validators: Sequence[str] = ()
    """Addresses of validators that orders may name; see the setting `known_validators`."""


GAS_OF: Final = {3: "gasUtilizing", 5: "gasConsumedOf"}


class ContractVersion:
    """Our own contracts. `factory` is the address of the factory; `generation` names the root of its names."""

    def __init__(self, node: Node, factory: str, generation: int) -> None:
        self.generation = generation
        self._node = node
        self._factory = node.contract("Factory", factory)
        self._liabilities: BoundedDict[str, None] = BoundedDict(65_536)

    takes_permits: ClassVar[bool] = True
    """Whether a contract can be created with a permit (EIP-2612)."""

    def ours(self, function: str) -> ContractFunctions:
        """The factory, for a function that only ours have. Raises `NotOffered`."""
        return self._factory

    def check_order(self, order: Order) -> None:
        """Raise `InvalidMessage` for an order that the contracts can't read."""

    def finalization(self, lighthouse: ContractFunctions, result: Result, *others: Result) -> ContractCall:
        """The call by which a provider finalizes a liability with its result, which `others` have signed, too.

        Raises `NotOffered`.
        """
        return lighthouse.finalizeLiability(result.liability, *result_arguments(result, *others))

    def validation(self, result: Result, *, agree: bool) -> ContractCall:
        """The call by which a generation-3 validator finalizes. Raises `NotOffered`."""
        liability = self._node.contract("Liability", result.liability)
        return liability.finalize(*result_arguments(result), agree)

    async def owed(self, token: str, account: str) -> int:
        """Units of a token that it refused to pay to an account, and that the factory keeps for it."""
        return int(await self._node.read(self._factory.owed(token, account)))

    async def nonce_of(self, address: str, *, block: int | str = "latest") -> int:
        """The nonce of an account's next generation-5 order, after a block. Raises `NotOffered`."""
        return int(await self._node.read(self._factory.nonceOf(address), block=block))

    async def is_order_used(self, order_hash: bytes, signer: str) -> bool:
        """Whether the generation-3 order that `signer` signed has created its liability or was withdrawn."""
        return bool(await self._node.read(self._factory.isOrderUsed(order_hash, signer)))

    def recognise(self, liability: str) -> None:
        """Remember an address as a liability, because the factory named it in an event."""
        self._liabilities[liability] = None  # the factory is asked about those that are forgotten

    async def is_liability(self, address: str) -> bool:
        """Whether the factory created the contract at an address.

        A node may be many machines: a "no" is asked for again as of the newest known block.
        """
        if address in self._liabilities:
            return True
        if await self._node.read(self._created(address)):
            self.recognise(address)
            return True
        return address in await self.recognised([address], (await self._node.heads.recent()).number)

    async def recognised(self, addresses: Collection[str], block: int) -> set[str]:
        """Those of some addresses at which the factory had created a contract by a block; 100 in one call.

        A machine of the node that lacks the block refuses to answer, so what is left out is no liability.
        """
        found = {address for address in addresses if address in self._liabilities}
        unknown = [address for address in addresses if address not in found]
        created = await self._node.read_all(map(self._created, unknown), block=block)
        for address in compress(unknown, created):
            self.recognise(address)
            found.add(address)
        return found

    async def are_liabilities(self, addresses: Sequence[str]) -> list[bool]:
        """Whether the factory created the contracts at these addresses, as of the latest block; 100 in one call."""
        return [bool(answer) for answer in await self._node.read_all(map(self._created, addresses), block="latest")]

    async def state(self, lighthouse: str) -> LighthouseState:
        """The state of a lighthouse, as of one block.

        Raises `NoContracts` if there is none, `InvalidAnswer` if it has too many providers, `NodeUnreachable`.
        """
        functions = self._node.contract("Lighthouse", lighthouse)
        rules = [functions[name]() for name in (*GETTERS[5].rules, "current")]
        calls = (functions.queue(ZERO_ADDRESS, LIGHTHOUSE_LIMITS.page), *rules)
        (*page, following), *values, current = await self._node.read_all(calls, block="latest")
        stakes = _paged({}, *page, address=lighthouse)
        if following == ZERO_ADDRESS:
            return _state(lighthouse, values, current, stakes)
        block, stakes, following = await self._node.block_number(), {}, ZERO_ADDRESS
        while not stakes or following != ZERO_ADDRESS:
            *page, following = await self._node.read(functions.queue(following, LIGHTHOUSE_LIMITS.page), block=block)
            if stakes and not page[0]:
                raise InvalidAnswer(f"queue of {lighthouse}", "an empty page")
            stakes = _paged(stakes, *page, address=lighthouse)
            if not stakes:
                break
        *values, current = await self._node.read_all(rules, block=block)
        return _state(lighthouse, values, current, stakes)

    async def is_turn(self, lighthouse: str, provider: str) -> bool:
        """Whether a provider may send in the next block."""
        functions = self._node.contract("Lighthouse", lighthouse)
        return bool(await self._node.read(functions.isTurnOf(provider), block="pending"))

    def _created(self, address: str) -> ContractCall:
        """The call that returns neither 0 nor false for a liability of the factory."""
        return self._factory.isLiability(address)


class OriginalContracts(ContractVersion):
    """The original contracts of one generation, which understand the orders of that generation only.

    They give no reasons when they refuse, pay nobody back, and don't say whose liability a contract is: a liability is
    recognised by an event of the factory that names it, or by the gas that the factory has counted for it.
    """

    takes_permits = False

    def ours(self, function: str) -> ContractFunctions:
        raise NotOffered(function, self.generation)

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
        call = super().validation(result, agree=True)  # only a validator, who finalizes on its own, can disagree
        return lighthouse.to(result.liability, call.data)

    def validation(self, result: Result, *, agree: bool) -> ContractCall:
        if self.generation == 5:
            raise NotOffered("finalization by a validator's own account", self.generation)
        if result.success and not agree:
            raise NotOffered("refusal by a validator: they would pay the promisor", self.generation)
        return super().validation(result, agree=agree)

    async def owed(self, token: str, account: str) -> int:
        """Nothing: a payment that is refused reverts the whole transaction."""
        return 0

    async def nonce_of(self, address: str, *, block: int | str = "latest") -> int:
        if self.generation == 3:
            raise NotOffered("nonceOf", self.generation)
        return await super().nonce_of(address, block=block)

    async def is_order_used(self, order_hash: bytes, signer: str) -> bool:
        """By any signer: the originals accept the same terms only once, even if another account signs them."""
        return bool(await self._node.read(self._factory.isHashConsumed(order_hash)))

    async def state(self, lighthouse: str) -> LighthouseState:
        """The list of providers is in the order of turns."""
        names, block = GETTERS[self.generation], await self._node.block_number()
        functions = self._node.contract("Lighthouse", lighthouse)
        count = await self._node.read(functions[names.length](), block=block)
        _check_count(lighthouse, count)
        found = await self._node.read_all((functions[names.at](index) for index in range(count)), block=block)
        stakes = await self._node.read_all((functions[names.stake](provider) for provider in found), block=block)
        rules = (functions[name]() for name in (*names.rules, "marker"))
        *values, marker = await self._node.read_all(rules, block=block)
        current = found[(marker - names.first) % count] if count else ZERO_ADDRESS
        by_provider = {parse_address(provider): stake for provider, stake in zip(found, stakes, strict=True)}
        return _state(lighthouse, values, current, by_provider)

    async def is_turn(self, lighthouse: str, provider: str) -> bool:
        """By the rule of the originals: the provider at the marker, or any provider after a timeout of silence."""
        state = await self.state(lighthouse)
        silence = await self._node.contract_block() + 1 - state.keep_alive_block
        return provider in state.stakes and (provider == state.current or silence > state.timeout_blocks)

    async def are_liabilities(self, addresses: Sequence[str]) -> list[bool]:
        counted = await super().are_liabilities(addresses)
        return [found or address in self._liabilities for address, found in zip(addresses, counted, strict=True)]

    def _created(self, address: str) -> ContractCall:
        return self._factory[GAS_OF[self.generation]](address)


def contract_version(kind: ContractKind, node: Node, factory: str, generation: int) -> ContractVersion:
    """The version for a kind and a generation. Raises `ConfigurationError` if there is none."""
    if generation not in GETTERS or kind not in ("mesh", "original"):
        raise ConfigurationError(
            f"there are no {kind} contracts of generation {generation}",
            hint='contracts are "mesh" or "original", generations 3 or 5',
            code="unknown-contracts",
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
        """The address of the account that signs. Raises as `signing`."""
        return self.signing().account.address

    def signing(self) -> TransactionSender:
        """The sender of the account's transactions. Raises `ConfigurationError` (`no-account`)."""
        if self.sender is None:
            raise ConfigurationError(
                "this needs an account", hint="set keyfile and keyfile_password_file", code="no-account"
            )
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
