"""What contracts hold, read as a whole, and what transactions with them came to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from schemas.address import ZERO_ADDRESS, parse_address
from schemas.cid import format_cid
from schemas.records import Liability

if TYPE_CHECKING:
    from mesh.chain.node import Node
    from mesh.chain.versions import Members

LIABILITY_GETTERS = (
    "model",
    "objective",
    "result",
    "promisee",
    "promisor",
    "lighthouse",
    "lighthouseFee",
    "token",
    "cost",
    "validator",
    "validatorFee",
    "isSuccess",
    "isFinalized",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class LighthouseState:
    """A lighthouse as it stands: stakes in wn, times in blocks, heights as block numbers."""

    address: str
    minimal_stake: int
    timeout_blocks: int
    keep_alive_block: int
    """The last block in which the provider whose turn it is sent something."""

    quota: int
    """Transactions that are left of the turn."""

    current: str
    """Whose turn it is; the zero address where nobody staked."""

    stakes: dict[str, int]
    """Providers in the order of their turns, with what each staked."""


@dataclass(frozen=True, slots=True)
class Created:
    """A liability that a transaction made, and the gas that it took, for so many wei."""

    liability: str
    tx: str
    gas_used: int
    wei: int


@dataclass(frozen=True, slots=True)
class Settled:
    """The transaction that finalized or refunded a liability, and the gas that it took, for so many wei.

    `minted` is the XRT (wn) that its sender was given for that.
    """

    tx: str
    gas_used: int
    wei: int
    minted: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RefundState:
    """Whether the promisee of a liability can be paid back, as of the block `block_number`."""

    liability: str
    block_number: int
    refundable_from: int
    """The first block in which anybody may have that done, if the liability has not ended by then."""

    is_finalized: bool

    @property
    def is_refundable(self) -> bool:
        """Whether a transaction in the next block could do it."""
        return not self.is_finalized and self.block_number + 1 >= self.refundable_from


async def read_liability(node: Node, address: str, *, block: int | None = None) -> Liability:
    """The terms and the outcome of what is known to be a liability, as of one block (by default the latest).

    Raises `NodeUnreachable`, and `NoContracts` for a block before it was made.
    """
    block = await node.block_number() if block is None else block
    functions = node.contract("Liability", address).functions
    values = await node.read_all((functions[getter]() for getter in LIABILITY_GETTERS), block=block)
    held: dict[str, Any] = dict(zip(LIABILITY_GETTERS, values, strict=True))
    return Liability(
        address=address,
        model=format_cid(held["model"]),
        objective=format_cid(held["objective"]),
        result=format_cid(held["result"]) if held["result"] else "",
        promisee=parse_address(held["promisee"]),
        promisor=parse_address(held["promisor"]),
        lighthouse=parse_address(held["lighthouse"]),
        lighthouse_fee=held["lighthouseFee"],
        token=parse_address(held["token"]),
        cost=held["cost"],
        validator=parse_address(held["validator"]),
        validator_fee=held["validatorFee"],
        is_success=held["isSuccess"],
        is_finalized=held["isFinalized"],
    )


async def lighthouse_state(node: Node, address: str, names: Members, *, current: str) -> LighthouseState:
    """The state of a lighthouse, as of one block. Raises `NoContracts` if there is none, `NodeUnreachable`.

    `current` is the getter of whose turn it is: of the provider's address, or of its place (`marker`).
    """
    block = await node.block_number()
    functions = node.contract("Lighthouse", address).functions
    count = await node.read(functions[names.length](), block=block)
    found = await node.read_all((functions[names.at](index) for index in range(count)), block=block)
    stakes = await node.read_all((functions[names.stake](provider) for provider in found), block=block)
    getters = (names.minimal_stake, names.timeout_blocks, names.keep_alive_block, "quota", current)
    values = await node.read_all((functions[getter]() for getter in getters), block=block)
    minimal_stake, timeout_blocks, keep_alive_block, quota, whose = values
    if current == "marker":
        whose = found[(whose - names.first) % count] if count else ZERO_ADDRESS
    return LighthouseState(
        address=address,
        minimal_stake=minimal_stake,
        timeout_blocks=timeout_blocks,
        keep_alive_block=keep_alive_block,
        quota=quota,
        current=parse_address(whose),
        stakes={parse_address(provider): stake for provider, stake in zip(found, stakes, strict=True)},
    )
