"""Prometheus metrics of a chain for one account: its transactions, their cost, its balances."""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING, Final

from mesh.errors import AiraError
from mesh.telemetry.metrics import MetricFamily, by_label, counter, gauge

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable

    from mesh.chain import Chain

log = logging.getLogger(__name__)

MAX_AGE: Final = 10.0
"""Seconds for which an answer of the node is reused."""
ASK_TIMEOUT: Final = 1.0
"""Seconds that the node may take; metrics that it does not answer by then are left out."""


class CachedMetrics:
    """Metrics that the node is asked for at most every `MAX_AGE` seconds, left out if it does not answer in time."""

    def __init__(self, ask: Callable[[], Awaitable[Iterable[MetricFamily]]]) -> None:
        self._ask = ask
        self._families: tuple[MetricFamily, ...] = ()
        self._asked_at = float("-inf")

    async def measure(self) -> tuple[MetricFamily, ...]:
        """The metrics, not older than `MAX_AGE`."""
        if time.monotonic() - self._asked_at >= MAX_AGE:
            self._asked_at = time.monotonic()
            try:
                async with asyncio.timeout(ASK_TIMEOUT):
                    self._families = tuple(await self._ask())
            except (AiraError, TimeoutError) as error:
                log.debug("metrics of the chain are left out: %s", error)
                self._families = ()
        return self._families


class ChainMetrics:
    """The metrics of an open chain, and of its account if it has one."""

    def __init__(self, chain: Chain) -> None:
        self._chain = chain
        self._balances = CachedMetrics(self._ask_balances)

    async def measure(self) -> tuple[MetricFamily, ...]:
        """The metrics now."""
        counted = self._chain.node.metrics.statistics()
        outcomes = {outcome.value: float(count) for outcome, count in counted.transactions.items()}
        return (
            by_label(
                "aira_transactions_total",
                "counter",
                "Transactions of this account, by what became of them",
                "outcome",
                outcomes,
            ),
            counter("aira_gas_used_total", "Gas that transactions on the chain have used", counted.gas_used),
            counter("aira_gas_spent_wei_total", "What that gas has cost, wei", counted.wei),
            counter("aira_node_failures_total", "Questions that no node of the chain answered", counted.failures),
            counter("aira_node_losses_total", "How often the nodes of the chain fell silent", counted.losses),
            *await self._balances.measure(),
        )

    async def _ask_balances(self) -> Iterable[MetricFamily]:
        if self._chain.account is None:
            return ()
        eth, xrt = await asyncio.gather(
            self._chain.tokens.eth_balance(), self._chain.tokens.balance(self._chain.account.address)
        )
        return (
            gauge("aira_account_eth_wei", "What the account has to pay gas with, wei", eth),
            gauge("aira_account_xrt_wn", "What the account has of XRT, wn", xrt),
        )


def reading_families(*, head: int, read_at: float) -> tuple[MetricFamily, ...]:
    """How far the chain was read: up to the block `head`, at the time `read_at` of the monotonic clock."""
    return (
        gauge("aira_chain_head_block", "The last block that was read", head),
        gauge("aira_chain_read_age_seconds", "Seconds since a block was read", time.monotonic() - read_at),
    )
