"""From settings to open parts: the account, the chain and the network that the settings name.

The command line, agents, bridges and tests compose their parts here, and nowhere else. The chain is imported on first
use: what runs without one never loads it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypedDict

from mesh.network import Endpoints

if TYPE_CHECKING:
    from pathlib import Path

    import zenoh

    from mesh.chain import Account, Chain
    from mesh.market.provider import Provider
    from mesh.settings import AccountSettings, ChainSettings, NetworkSettings, Settings
    from mesh.settings.groups import StorageSettings


def load_account(settings: AccountSettings) -> Account:
    """The account that the settings name. Blocks while the keyfile is decrypted. Raises `ConfigurationError`."""
    from mesh.chain import Account

    return Account.from_keyfile(*settings.keyfile_and_password())


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
        ens=settings.ens_contract,
        factory=settings.factory_contract,
        xrt=settings.xrt_contract,
        generation=settings.generation,
        contracts=settings.contracts,
        timing=Timing(
            poll_interval=settings.poll_interval,
            confirmations=settings.confirmations,
            reorg_depth=settings.reorg_depth,
            attempts=attempts,
        ),
        fees=FeePolicy(ceiling=round(settings.max_fee_gwei * GWEI)),
        transactions=settings.state_directory / "transactions",
    )


class ProviderFiles(TypedDict):
    """The files of a `Provider`, as it takes them."""

    withdrawals: Path
    sent_orders: Path


async def provider_files(settings: StorageSettings, chain: Chain, address: str, lighthouse: str) -> ProviderFiles:
    """The files of an account's provider on a chain, for a lighthouse (ENS name)."""
    folder, name = await state_folder(settings, chain, address), f"{lighthouse.lower()}.sqlite"
    return ProviderFiles(withdrawals=folder / f"withdrawals-{name}", sent_orders=folder / f"sent-orders-{name}")


async def provider_of(settings: Settings, session: zenoh.Session, chain: Chain) -> Provider:
    """The provider that the settings name, not yet opened, with the account of an open chain."""
    from mesh.blocklist import blocklist_at
    from mesh.market.provider import Provider

    assert chain.account is not None
    lighthouse = settings.lighthouse_contract
    return Provider(
        session,
        chain,
        lighthouse,
        limit=settings.open_orders_limit,
        unmined_limit=settings.unmined_limit,
        deadline_limit=settings.deadline_limit,
        blocked=blocklist_at(settings.blocked_signers),
        **await provider_files(settings, chain, chain.account.address, lighthouse),
    )


async def state_folder(settings: StorageSettings, chain: Chain, address: str) -> Path:
    """The folder of an account's files that belong to this chain, such as its ledger.

    Only this chain has its name: a restarted development chain has the same number, with other contracts.
    """
    first = await chain.node.block_hash(min(1, await chain.block_number()))
    return settings.state_directory / address / f"{chain.chain_id}-{first.hex()[:8]}"


def endpoints_of(settings: NetworkSettings) -> Endpoints:
    """Where the settings' client session connects to."""
    return Endpoints.from_settings(settings)
