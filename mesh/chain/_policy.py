"""What the operator of an account decides: how long to wait for the chain, and how much to pay for gas (EIP-1559)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypeAlias

from mesh.base.retry import RetryPolicy
from mesh.chain.errors import FeeTooHigh

if TYPE_CHECKING:
    from collections.abc import Mapping

REORG_DEPTH: Final = 12
"""Blocks behind the head that are remembered by default; public chains reorganise one or two."""

Finality: TypeAlias = Literal["latest", "safe", "finalized"]

GWEI: Final = 10**9
"""Wei."""

NODES_BUMP_PERCENT: Final = 10
"""By how much nodes want both prices raised to let a transaction take another's place (geth's `pricebump`)."""
BUMP_PERCENT: Final = 15
"""By how much they are raised, at least, where the ceiling allows it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """Waiting times, in seconds unless said otherwise."""

    poll_interval: float = 1.0
    """Between two looks for a new block, where blocks don't come at a slower pace."""
    receipt_interval: float = 0.1
    """Before the second look for a transaction's receipt, where blocks don't come at a known pace; the others follow
    each new block."""
    receipt_timeout: float = 180.0
    """How long a sent transaction is waited for."""
    confirmations: int = 1
    """Blocks, not seconds: how many a transaction needs, its own included, to count as mined."""
    finality: Finality = "latest"
    """Which blocks count where others may still take something back: those with `confirmations`, or those that the
    node calls safe or finalized. For one's own transactions it is the confirmations that count."""
    replace_after: float = 30.0
    """After how long a transaction that is not mined is sent again with higher fees, each time."""
    repeat_within: float = 600.0
    """How long after a transaction with an unknown outcome the same transaction means that one, if it was mined."""
    metrics_age: float = 10.0
    """How old a metric that comes from the node may be."""
    validator_recheck: float = 60.0
    """How long an answer about a validator is trusted while a transaction can still change it."""
    request_timeout: float = 15.0
    """For one answer of the node."""
    first_timeout: float = 3.0
    """For the answers of a server that has not answered yet as a node does; it gets only one attempt to answer."""
    attempts: int = 4
    """How often a request is made before the node counts as unreachable."""
    retry_delay: float = 0.25
    """Before the second attempt; doubled before each further one."""
    reorg_depth: int = REORG_DEPTH
    """Blocks, not seconds: how far behind the head replaced blocks are noticed."""

    @property
    def request_retry(self) -> RetryPolicy:
        """For one request, after which the node counts as unreachable."""
        return RetryPolicy(initial=self.retry_delay, ceiling=max(60.0, self.retry_delay), attempts=self.attempts)

    @property
    def outage_retry(self) -> RetryPolicy:
        """For a node that is unreachable: from `poll_interval` to ten times as long, without end."""
        return RetryPolicy(initial=self.poll_interval, ceiling=10 * self.poll_interval)


class Fees(NamedTuple):
    """Prices of a unit of gas, in wei (EIP-1559); without `priority`, the one price of a chain without a base fee."""

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


class GasMarket(NamedTuple):
    """The price of a unit of gas now, in wei, and fees that leave room for the base fee to double."""

    price: int
    fees: Fees


@dataclass(frozen=True, slots=True, kw_only=True)
class FeePolicy:
    """How much an account is ready to pay. Prices are wei for a unit of gas."""

    ceiling: int = 500 * GWEI
    """The most that is ever offered, base fee and priority fee together."""

    def offer(self, market: GasMarket) -> Fees:
        """What a transaction offers, within the ceiling. Raises `FeeTooHigh` for a price above it."""
        if market.price > self.ceiling:
            raise FeeTooHigh(market.price, self.ceiling)
        return Fees(min(market.fees.maximum, self.ceiling), market.fees.priority)

    def replacement(self, market: GasMarket, fees: Fees) -> Fees | None:
        """What the replacement of a stuck transaction with `fees` offers: more, and no less than the market's price.

        None if the ceiling leaves no room for what nodes accept as a replacement.
        """
        offered = market.fees
        maximum = min(self.ceiling, max(offered.maximum, _raised(fees.maximum, BUMP_PERCENT)))
        if maximum < _raised(fees.maximum, NODES_BUMP_PERCENT):
            return None
        if fees.priority is None:
            return Fees(maximum, None)
        priority = max(offered.priority or 0, _raised(fees.priority, BUMP_PERCENT))
        return Fees(maximum, min(priority, maximum))


def _raised(price: int, percent: int) -> int:
    """A price raised by that many percent, rounded up."""
    return price + (price * percent + 99) // 100
