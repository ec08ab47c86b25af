"""A chain to develop on, served to other processes, with keyfiles for who uses it."""

from __future__ import annotations

import asyncio
import secrets
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mesh.chain import serve_embedded, write_keyfile
from mesh.demo.market import ROLES, Market, found_market
from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.settings import Settings


@dataclass(frozen=True, kw_only=True)
class DevelopmentChain:
    """A served chain: where it is, what is on it, and the folder of the keyfiles and their password."""

    url: str
    market: Market
    keys: Path

    def describe(self) -> str:
        """What a person needs to use it, a line each."""
        deployment = self.market.deployment
        lines = [
            f"chain       {self.url}",
            f"lighthouse  {deployment.lighthouse_name}",
            *(f"{role:<11} {self.keys / role}.json  {self.market.accounts[role].address}" for role in ROLES[1:]),
            f"password    {self.keys / 'password'}",
        ]
        return "\n".join(lines)


@asynccontextmanager
async def serve_chain(
    settings: Settings, *, host: str, port: int, block_time: float | None
) -> AsyncIterator[DevelopmentChain]:
    """Serve an embedded chain with a market on it; `block_time` in seconds. Everything on it is gone at the end.

    Raises `ConfigurationError` when the port is taken or the keyfiles can't be written.
    """
    keys = settings.state_directory / "development"
    async with serve_embedded(host, port, block_time=block_time) as served:
        market = await found_market(served.node.provider, served.node.funded_keys)
        try:
            await asyncio.to_thread(_write_keyfiles, keys, served.node.funded_keys)
        except OSError as error:
            raise ConfigurationError(
                f"can't write keyfiles to {keys}: {error.strerror}", hint="name another folder with --data-dir"
            ) from None
        yield DevelopmentChain(url=served.url, market=market, keys=keys)


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
