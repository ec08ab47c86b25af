"""From settings to open parts: the account, the chain, the network and the files that the settings name.

The command line, roles, bridges and tests compose their parts here, and nowhere else. The chain is imported on first
use: what runs without one never loads it.
"""

from __future__ import annotations

import asyncio
import logging
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

from mesh.base.database import RoleLedger
from mesh.base.fresh_file import blocklist_at
from mesh.base.outage_log import OutageLog
from mesh.base.retry import Backoff
from mesh.content import Exchange, Store
from mesh.content.store import make_store
from mesh.errors import NetworkUnavailable
from mesh.network import Channel, Endpoints, MarketRules, Network, Services
from mesh.role.handover import adopt_content, check_not_retired

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from contextlib import AsyncExitStack
    from pathlib import Path

    from mesh.base.flood import Drops
    from mesh.chain import Account, Chain, ContractNames
    from mesh.role.following import ChainHead
    from mesh.settings import AccountSettings, ChainSettings, Settings
    from mesh.settings.groups import StorageSettings
    from schemas import Signer

log = logging.getLogger(__name__)

L = TypeVar("L", bound=RoleLedger)


@dataclass(frozen=True, kw_only=True)
class RoleParts(Generic[L]):
    """What a role with an account and a ledger has open."""

    settings: Settings
    network: Network
    chain: Chain
    channel: Channel
    signer: Signer
    ledger: L
    store: Store
    exchange: Exchange
    services: Services
    chain_head: ChainHead
    outages: OutageLog
    """Outages of the node, for everything that waits for it."""
    drops: Drops
    """What was dropped because of floods."""
    directory: Path
    """The folder of what belongs to this chain: the ledger and unfinished recordings."""


async def opened_chain(stack: AsyncExitStack, settings: Settings, account: Account, chain: Chain | None) -> Chain:
    """`chain` (open), or the chain that the settings name; its node has what a role needs."""
    if chain is None:
        chain = await stack.enter_async_context(chain_of(settings, account))
    await chain.node.check_calls(account.address)
    return chain


async def open_parts(
    stack: AsyncExitStack,
    settings: Settings,
    account: Account,
    chain: Chain,
    *,
    ledger: Callable[[Path], L],
    drops: Drops,
    lookback: int | None = None,
) -> RoleParts[L]:
    """Open the parts of a role on `chain`, with the `ledger` in the folder of what belongs to that chain.

    It has handled all blocks that its ledger says, or the last ones before `lookback` blocks: see `first_position`.
    """
    from mesh.role.following import ChainHead, first_position

    enter = stack.enter_async_context
    check_not_retired(settings.state_directory, account.address)
    directory = await state_folder(settings, chain, account.address)
    opened = ledger(directory)
    await enter(opened)
    head = await ChainHead.at(chain, await first_position(opened, chain, lookback=lookback))
    network, channel = await enter(connected(settings, chain, head, drops))
    adopt_content(settings.state_directory, account.address)
    store = await open_store(stack, settings, directory.parent / "content", limit=settings.objective_expanded_limit)
    return RoleParts(
        settings=settings,
        network=network,
        chain=chain,
        channel=channel,
        signer=account.signer,
        ledger=opened,
        store=store,
        exchange=await enter(Exchange(network.session, store, address=account.address.lower(), drops=drops)),
        services=await enter(Services(network.session, account.address, drops=drops)),
        chain_head=head,
        outages=OutageLog(log, "chain"),
        drops=drops,
        directory=directory,
    )


@asynccontextmanager
async def watching(settings: Settings, *, drops: Drops | None = None) -> AsyncIterator[tuple[Network, Channel]]:
    """What a role has open that only watches the market: it needs a router, but no account and no chain."""
    async with (
        Network(Endpoints.from_settings(settings)) as network,
        Channel(
            network.session, settings.lighthouse_contract, drops=drops, answer_timeout=settings.answer_timeout
        ) as channel,
    ):
        yield network, channel


@asynccontextmanager
async def connected(
    settings: Settings, chain: Chain, head: ChainHead, drops: Drops
) -> AsyncIterator[tuple[Network, Channel]]:
    """A session, and the channel of the lighthouse, which resolves names and knows the head by the chain."""
    async with (
        Network(Endpoints.from_settings(settings)) as network,
        Channel(
            network.session,
            MarketRules(
                settings.lighthouse_contract,
                address=await chain.names.address(settings.lighthouse_contract),
                resolver=chain.names.address,
                validators=chain.validators,
                head=lambda: head.contract_block,
                blocked=blocklist_at(settings.blocked_signers),
            ),
            drops=drops,
            answer_timeout=settings.answer_timeout,
        ) as channel,
    ):
        yield network, channel


def load_account(settings: AccountSettings) -> Account:
    """The account that the settings name. Blocks while the keyfile is decrypted. Raises `ConfigurationError`."""
    from mesh.chain import Account

    return Account.from_keyfile(*settings.keyfile_and_password())


def contract_names(settings: ChainSettings) -> ContractNames:
    """Which contracts the settings mean."""
    from mesh.chain import ContractNames

    return ContractNames(
        ens=settings.ens_contract,
        generation=settings.generation,
        factory=settings.factory_contract,
        xrt=settings.xrt_contract,
        kind=settings.contracts,
        validators=settings.known_validators,
    )


def chain_of(settings: ChainSettings, account: Account | None, *, attempts: int = 4) -> Chain:
    """The chain that the settings name, not yet opened, for `account` or for reading only.

    A request is made up to `attempts` times before the node counts as unreachable.

    What is sent is written down in the settings' folder, so that a number that was used stays used after a restart,
    and in other programs of the same account. Raises `ConfigurationError`.
    """
    from mesh.chain import GWEI, Chain, FeePolicy, Timing

    return Chain(
        settings.node,
        account=account,
        contracts=contract_names(settings),
        timing=Timing(
            poll_interval=settings.poll_interval,
            confirmations=settings.confirmations,
            finality=settings.finality,
            reorg_depth=settings.reorg_depth,
            attempts=attempts,
        ),
        fees=FeePolicy(ceiling=round(settings.max_fee_gwei * GWEI)),
        transactions=settings.state_directory / "transactions",
        profile=settings.profile,
    )


async def state_folder(settings: StorageSettings, chain: Chain, address: str) -> Path:
    """The folder of an account's files that belong to this chain, such as its ledger.

    Only this chain has its name: a restarted development chain has the same number, with other contracts.
    """
    first = await chain.node.block_hash(min(1, await chain.block_number()))
    return settings.state_directory / address / f"{chain.chain_id}-{first.hex()[:8]}"


async def open_store(stack: AsyncExitStack, settings: Settings, folder: Path, *, limit: int) -> Store:
    """Files by CID in a folder, closed with `stack`. `limit` is the largest file, bytes."""
    store = await asyncio.to_thread(make_store, settings, folder, limit=limit)
    stack.callback(store.close)
    return store


async def open_network(
    stack: AsyncExitStack, endpoints: Endpoints, outage: OutageLog, *, on_wait: Callable[[str], None]
) -> Network:
    """A session on `stack`, as soon as its router answers; `on_wait` is called with the error of each attempt."""
    backoff = Backoff()
    while True:
        try:
            network = await stack.enter_async_context(Network(endpoints))
        except NetworkUnavailable as error:
            outage.failed(error, "the bridge waits for a router")
            on_wait(str(error))
            await backoff.wait()
        else:
            outage.recovered("a router answers")
            return network
