"""The components of a validator, the order in which they are opened, and what it checks before that."""

from __future__ import annotations

import asyncio
import logging
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mesh.agent.components import ChainHead, connected
from mesh.chain import ChainWentBack
from mesh.composition import chain_of, state_folder
from mesh.content import Exchange, Store
from mesh.errors import ChainError
from mesh.log_context import log_event
from mesh.network import Services
from mesh.outage_log import OutageLog
from mesh.validator.ledger import VERDICTS, VerdictLedger

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence
    from pathlib import Path

    from mesh.chain import Account, Chain
    from mesh.flood import Drops
    from mesh.network import Channel, Network
    from mesh.settings import Settings
    from mesh.validator.policy import Policy
    from schemas import Signer

log = logging.getLogger(__name__)

LOOKBACK: Final = 50_400
"""Blocks that a validator reads at most of those before its start: after so many, liabilities can be refunded."""


class NotAValidator(ChainError, code="not-a-validator"):
    """The setting `validator_contract` names a lighthouse, or no validator contract."""

    def __init__(self, contract: str, why: str) -> None:
        hint = "create one with `aira validator deploy`, then pass its address with --validator-contract"
        super().__init__(f"{contract} {why}", hint=hint)
        self.contract = contract


class NotAJuror(ChainError, code="not-a-juror"):
    """The validator contract does not accept the signature of this account."""

    def __init__(self, contract: str, account: str) -> None:
        super().__init__(
            f"{account} is no juror of the validator contract {contract}",
            hint="create a contract that names this account: `aira validator deploy`",
        )
        self.contract = contract
        self.account = account


@dataclass(frozen=True, kw_only=True)
class Bench:
    """As what a validator judges: its account (generation 3) and, if it has one, its contract (generation 5).

    A result needs the signatures of `quorum` of the contract's `jurors`.
    """

    account: str
    contract: str = ""
    quorum: int = 1
    jurors: int = 1

    @property
    def validators(self) -> tuple[str, ...]:
        """The addresses that liabilities may name, the contract first."""
        return (self.contract, self.account) if self.contract else (self.account,)


@dataclass(frozen=True, kw_only=True)
class ValidatorTerms:
    """How a validator judges, and for what least fee (wn)."""

    policies: Sequence[Policy]
    fee: int
    title: str


@dataclass(frozen=True, kw_only=True)
class ValidatorComponents:
    """The open components of a validator."""

    settings: Settings
    terms: ValidatorTerms
    bench: Bench
    network: Network
    chain: Chain
    channel: Channel
    signer: Signer
    ledger: VerdictLedger
    store: Store
    exchange: Exchange
    services: Services
    chain_head: ChainHead
    outages: OutageLog
    """Outages of the node, for everything that waits for it."""
    drops: Drops
    """What was dropped because of floods."""
    directory: Path
    """The folder of what belongs to this chain."""


@asynccontextmanager
async def judging(
    settings: Settings, account: Account, chain: Chain | None, *, terms: ValidatorTerms, drops: Drops
) -> AsyncIterator[ValidatorComponents]:
    """The components of a validator on `chain` (open), or on the chain that the settings name.

    Raises `NotAValidator`, `NotAJuror`, and the errors of opening what it needs.
    """
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        if chain is None:
            chain = await enter(chain_of(settings, account))
        bench = await bench_of(chain, account.address, settings.validator_contract)
        directory = await state_folder(settings, chain, account.address)
        ledger = await enter(VerdictLedger(directory / VERDICTS, account.signer))
        chain_head = ChainHead(await _handled(ledger, chain))
        network, channel = await enter(connected(settings, chain, chain_head, drops))
        store = await asyncio.to_thread(
            Store, directory.parent / "content", limit=settings.objective_expanded_limit, quota=settings.content_limit
        )
        stack.callback(store.close)
        yield ValidatorComponents(
            settings=settings,
            terms=terms,
            bench=bench,
            network=network,
            chain=chain,
            channel=channel,
            signer=account.signer,
            ledger=ledger,
            store=store,
            exchange=await enter(Exchange(network.session, store, address=account.address.lower(), drops=drops)),
            services=await enter(Services(network.session, account.address, drops=drops)),
            chain_head=chain_head,
            outages=OutageLog(log, "chain"),
            drops=drops,
            directory=directory,
        )


async def bench_of(chain: Chain, account: str, contract: str) -> Bench:
    """As what the account may judge, with the contract (ENS name or address) that the settings name, if any.

    Raises `NotAValidator`, `NotAJuror`, and the errors of reading the chain.
    """
    if not contract:
        await _warn_without_eth(chain, account)
        return Bench(account=account)
    address = await chain.names.address(contract)
    if await chain.lighthouses.exists(address):
        raise NotAValidator(address, "is a lighthouse, not a validator contract")
    if not await chain.node.code(address):
        raise NotAValidator(address, "has no code: it is not a validator contract")
    if not await chain.validators.accepts(address, account):
        raise NotAJuror(address, account)
    jury = await chain.validators.jury(address)
    if jury is None:  # another contract with `isValidator`, to which one signature is enough
        return Bench(account=account, contract=address)
    return Bench(account=account, contract=address, quorum=jury.quorum, jurors=len(jury.jurors))


async def _warn_without_eth(chain: Chain, account: str) -> None:
    """Say what is missing for generation 3, where the validator itself finalizes."""
    if not await chain.tokens.eth_balance():
        log.warning(
            "%s has no ETH: it can't finalize liabilities that name the account itself",
            account,
            extra=log_event("validator-without-eth", account=account),
        )


async def _handled(ledger: VerdictLedger, chain: Chain) -> int:
    """The last block that was handled, or before which nothing is read. Raises `ChainWentBack` for another chain."""
    (handled, _), head = await ledger.cursor(), await chain.block_number()
    if handled is None or handled < head - LOOKBACK:
        start = max(head - LOOKBACK, 0)
        await ledger.set_cursor(start)
        return start
    if handled > head + chain.node.timing.reorg_depth:
        raise ChainWentBack(handled + 1, head)
    return handled
