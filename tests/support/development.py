"""The accounts of a development market, `aira up` or `aira chain up`, whose keys are in its folder."""

from __future__ import annotations

from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

from mesh.dev import EmbeddedChain, JsonRpcServer
from mesh.settings import Settings

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path


def variables_of(role: str, folder: Path, *, url: str, **settings: str) -> dict[str, str]:
    """The environment of a command that one of them runs at that node, with other settings by their names."""
    keys = folder / "development"
    named = {
        "web3_http_provider": url,
        "data_dir": str(folder),
        "keyfile": str(keys / f"{role}.json"),
        "keyfile_password_file": str(keys / "password"),
        "poll_interval": "0.1",
    }
    return {f"AIRA_{name.upper()}": value for name, value in (named | settings).items()}


def settings_of(role: str, folder: Path, *, url: str, endpoint: str, **options: Any) -> Settings:
    """The settings of one of them in this process, at that node and router; jobs are played at once."""
    keys = folder / "development"
    return Settings(
        connect=(endpoint,),
        web3_http_provider=url,
        data_dir=str(folder / role),
        poll_interval=0.05,
        playback="at-once",
        keyfile=str(keys / f"{role}.json"),
        keyfile_password_file=str(keys / "password"),
        **options,
    )


class ServedChain(NamedTuple):
    """An embedded chain, and the server in front of it."""

    node: EmbeddedChain
    server: JsonRpcServer

    @property
    def url(self) -> str:
        """Where other processes reach it, e.g. `http://127.0.0.1:8545`."""
        return self.server.url


@asynccontextmanager
async def serve_embedded(*, port: int = 0) -> AsyncIterator[ServedChain]:
    """An embedded chain that other processes share over JSON-RPC; port 0 takes a free one."""
    async with EmbeddedChain() as node, JsonRpcServer(node.provider, port=port) as server:
        yield ServedChain(node, server)
