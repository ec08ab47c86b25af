"""What a transaction pays for gas: the market's price, up to a ceiling of one's own (EIP-1559)."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from mesh.chain.errors import FeeTooHigh, RequestRefused
from mesh.devchain.jsonrpc import METHOD_NOT_FOUND
from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.chain.node import Node

GWEI: Final = 10**9
"""Wei."""

NODES_BUMP_PERCENT: Final = 10
"""By how much nodes want both prices raised to let a transaction take another's place (geth's `pricebump`)."""


@dataclass(frozen=True, slots=True)
class Fees:
    """Prices of a unit of gas, in wei (EIP-1559), or the one price of a chain without a base fee."""

    maximum: int
    priority: int | None

    @classmethod
    def of(cls, fields: Mapping[str, Any]) -> Fees:
        """The prices in a transaction's fields."""
        if "gasPrice" in fields:
            return cls(fields["gasPrice"], None)
        return cls(fields["maxFeePerGas"], fields["maxPriorityFeePerGas"])

    def fields(self) -> dict[str, int]:
        """The transaction's fields."""
        if self.priority is None:
            return {"gasPrice": self.maximum}
        return {"type": 2, "maxFeePerGas": self.maximum, "maxPriorityFeePerGas": self.priority}


@dataclass(frozen=True, slots=True, kw_only=True)
class FeePolicy:
    """How much an account is ready to pay. Prices are wei for a unit of gas."""

    ceiling: int = 500 * GWEI
    """The most that is ever offered, base fee and priority fee together."""

    patience: float = 0.0
    """Seconds to wait for a price above the ceiling to come down, before the transaction is refused."""

    bump_percent: int = 15
    """By how much a transaction that is stuck is made dearer, at least."""

    def __post_init__(self) -> None:
        if self.ceiling < 1 or self.patience < 0 or self.bump_percent < NODES_BUMP_PERCENT:
            raise ConfigurationError(
                "fees have a ceiling above zero, no negative patience, and grow by 10 % at least when replaced"
            )

    async def fees(self, node: Node) -> Fees:
        """What a transaction offers now: room for the base fee to double, within the ceiling.

        Raises `FeeTooHigh` when the price stays above the ceiling, `NodeUnreachable`.
        """
        loop = asyncio.get_running_loop()
        until = loop.time() + self.patience
        while True:
            price, offered = await _market(node)
            if price <= self.ceiling:
                return Fees(min(offered.maximum, self.ceiling), offered.priority)
            if loop.time() >= until:
                raise FeeTooHigh(price, self.ceiling)
            await asyncio.sleep(node.timing.poll_interval)

    async def bumped(self, node: Node, fees: Fees) -> Fees | None:
        """What takes the place of a stuck transaction: dearer, and no less than the market's price.

        None if the ceiling leaves no room for what nodes accept as a replacement.
        """
        _, offered = await _market(node)
        maximum = min(self.ceiling, max(offered.maximum, _raised(fees.maximum, self.bump_percent)))
        if maximum < _raised(fees.maximum, NODES_BUMP_PERCENT):
            return None
        if fees.priority is None:
            return Fees(maximum, None)
        priority = max(offered.priority or 0, _raised(fees.priority, self.bump_percent))
        return Fees(maximum, min(priority, maximum))


async def _market(node: Node) -> tuple[int, Fees]:
    """What a unit of gas costs in the latest block with the priority fee that the node suggests, and an offer."""
    eth = node.web3.eth
    base = (await eth.get_block("latest")).get("baseFeePerGas")
    if base is None:
        price = int(await eth.gas_price)
        return price, Fees(maximum=price, priority=None)
    priority = await _suggested_priority(node, int(base))
    return int(base) + priority, Fees(maximum=2 * int(base) + priority, priority=priority)


async def _suggested_priority(node: Node, base: int) -> int:
    """The priority fee that the node suggests; what its gas price is above the base fee where it has no word for it."""
    try:
        return int(await node.web3.eth.max_priority_fee)
    except RequestRefused as refused:
        if refused.rpc_code != METHOD_NOT_FOUND:
            raise
        return max(int(await node.web3.eth.gas_price) - base, 0)


def _raised(price: int, percent: int) -> int:
    """A price raised by that many percent, rounded up."""
    return price + (price * percent + 99) // 100
