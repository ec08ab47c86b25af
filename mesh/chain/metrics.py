"""The figures of a chain as one account of it sees it: transactions, what they cost, and what the account has."""

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

FRESH: Final = 10.0
"""Seconds for which what the chain said is told again, without asking."""
PATIENCE: Final = 1.0
"""Seconds that a node may take; what it does not say by then is left out."""


class Asked:
    """Figures that have to be asked of the node: now and then, and left out where it does not answer soon."""

    def __init__(self, ask: Callable[[], Awaitable[Iterable[MetricFamily]]]) -> None:
        self._ask = ask
        self._families: tuple[MetricFamily, ...] = ()
        self._asked_at = float("-inf")

    async def measure(self) -> tuple[MetricFamily, ...]:
        """The figures, not older than `FRESH`."""
        if time.monotonic() - self._asked_at >= FRESH:
            self._asked_at = time.monotonic()
            try:
                async with asyncio.timeout(PATIENCE):
                    self._families = tuple(await self._ask())
            except (AiraError, TimeoutError) as error:
                log.debug("figures of the chain are left out: %s", error)
                self._families = ()
        return self._families


class ChainMetrics:
    """The figures of `chain`, which is open, and of its account if it has one."""

    def __init__(self, chain: Chain) -> None:
        self._chain = chain
        self._balances = Asked(self._ask_balances)

    async def measure(self) -> tuple[MetricFamily, ...]:
        """The figures now."""
        counted = self._chain.node.metrics.statistics()
        fates = {fate.value: float(count) for fate, count in counted.transactions.items()}
        return (
            by_label(
                "aira_transactions_total",
                "counter",
                "Transactions of this account, by what became of them",
                "outcome",
                fates,
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
    """How far the chain was read: up to the block `head`, at `read_at` of the monotonic clock."""
    return (
        gauge("aira_chain_head_block", "The last block that was read", head),
        gauge("aira_chain_read_age_seconds", "Seconds since a block was read", time.monotonic() - read_at),
    )
