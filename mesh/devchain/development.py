"""A chain to develop on, served to other processes, with keyfiles for who uses it."""

from __future__ import annotations

import asyncio
import secrets
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mesh.chain import NoContracts, write_keyfile
from mesh.devchain import serve_embedded
from mesh.devchain.anvil import serve_anvil
from mesh.devchain.anvil_state import founding
from mesh.devchain.market import ROLES, Market, find_market, found_market
from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.settings import Settings


@dataclass(frozen=True, kw_only=True)
class DevelopmentChain:
    """A served chain: where it is, what is on it, and the folder of the keyfiles and their password."""

    url: str
    """JSON-RPC over HTTP; over a WebSocket it is at the same port."""

    engine: str
    """What runs it, for people to read."""

    market: Market
    keys: Path

    @property
    def ws_url(self) -> str:
        """The same for clients that subscribe to events, e.g. `ws://127.0.0.1:8545`."""
        return self.url.replace("http", "ws", 1)

    def describe(self) -> str:
        """What a person needs to use it, a line each."""
        deployment = self.market.deployment
        lines = [
            f"chain       {self.url}",
            f"websocket   {self.ws_url}",
            f"engine      {self.engine}",
            f"lighthouse  {deployment.lighthouse_name}",
            *(f"{role:<11} {self.keys / role}.json  {self.market.accounts[role].address}" for role in ROLES[1:]),
            f"password    {self.keys / 'password'}",
        ]
        return "\n".join(lines)

    def facts(self) -> dict[str, Any]:
        """The same for programs, with the contracts' addresses."""
        deployment = self.market.deployment
        accounts = {
            role: {"address": account.address, "keyfile": str(self.keys / f"{role}.json")}
            for role, account in self.market.accounts.items()
        }
        return {
            "chain": self.url,
            "webSocket": self.ws_url,
            "engine": self.engine,
            "ens": deployment.ens,
            "factory": deployment.factory,
            "xrt": deployment.xrt,
            "lighthouse": deployment.lighthouse,
            "lighthouseName": deployment.lighthouse_name,
            "accounts": accounts,
            "passwordFile": str(self.keys / "password"),
        }


@asynccontextmanager
async def serve_chain(
    settings: Settings,
    *,
    host: str,
    port: int,
    block_time: float | None,
    anvil: Path | None = None,
    state: Path | None = None,
) -> AsyncIterator[DevelopmentChain]:
    """Serve a chain with a market on it: by the program `anvil`, embedded without one. `block_time` in seconds.

    Everything on it is gone at the end, unless anvil keeps it in the file `state`. Raises `ConfigurationError` when the
    port is taken, the keyfiles can't be written or the state can't be used; `NodeEnded` when anvil ends by itself.
    """
    keys = settings.state_directory / "development"
    async with AsyncExitStack() as stack:
        if anvil is None:
            served = await stack.enter_async_context(serve_embedded(host, port, block_time=block_time))
            url, funded, engine = served.url, served.node.funded_keys, "embedded"
            market = await found_market(served.node.provider, funded)
        else:
            node = await stack.enter_async_context(
                serve_anvil(anvil, host=host, port=port, block_time=block_time, state=state)
            )
            url, funded, engine = node.url, node.funded_keys, f"anvil ({anvil})"
            market = await _market_of(node.url, funded, state)
        try:
            await asyncio.to_thread(_write_keyfiles, keys, funded)
        except OSError as error:
            raise ConfigurationError(
                f"can't write keyfiles to {keys}: {error.strerror}", hint="name another folder with --data-dir"
            ) from None
        yield DevelopmentChain(url=url, engine=engine, market=market, keys=keys)


async def _market_of(url: str, keys: tuple[bytes, ...], state: Path | None) -> Market:
    """The market on a chain that may have one from an earlier time, founded where the chain is new."""
    try:
        found = await find_market(url, keys)
    except NoContracts:
        raise ConfigurationError(
            f"the chain in {state} has no market on it, and is not new", hint="name another file, or remove it"
        ) from None
    if found is not None:
        return found
    with founding(state):
        return await found_market(url, keys)


def _write_keyfiles(folder: Path, private_keys: tuple[bytes, ...]) -> None:
    """A keyfile a role under one random password. The keys are public knowledge: never use them on a real chain."""
    folder.mkdir(parents=True, exist_ok=True)
    password = folder / "password"
    if not password.exists():
        password.write_text(secrets.token_urlsafe(12) + "\n")
        password.chmod(0o600)
    for role, key in zip(ROLES, private_keys, strict=False):
        keyfile = folder / f"{role}.json"
        if not keyfile.exists():
            write_keyfile(keyfile, key, password.read_text().strip())
