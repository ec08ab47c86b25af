"""A development chain with a market on it: deploying it, serving it, watching whether it answers; and a program beside
it, which is started again when its files change."""

from __future__ import annotations

import asyncio
import os
import secrets
import sys
import tempfile
from contextlib import AsyncExitStack, asynccontextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from mesh.base.private_files import make_private_folder, write_new
from mesh.chain import (
    XRT,
    Account,
    Chain,
    Deployment,
    DeploymentPlan,
    NoContracts,
    Node,
    NodeUnreachable,
    RequestRefused,
    Timing,
    deploy,
    namehash,
    write_keyfile,
)
from mesh.dev._embedded import EmbeddedChain, EmbeddedProvider
from mesh.dev._rpc import JsonRpcServer
from mesh.dev.anvil import check_port, prepare_state, serve_anvil, write_state
from mesh.errors import ConfigurationError
from mesh.telemetry.metrics import MetricFamily, gauge
from schemas.status import ALIVE

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping, Sequence

    from mesh.chain.rpc import Transport
    from mesh.settings import StorageSettings


class ChainMonitor:
    """Checks the chain of an open `node` each second while `run` runs."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._head: int | None = None

    async def run(self) -> None:
        """Check until cancelled."""
        while True:
            try:
                self._head = await self._node.block_number()
            except (NodeUnreachable, RequestRefused):
                self._head = None
            await asyncio.sleep(1)

    async def measure(self) -> tuple[MetricFamily, ...]:
        """The number of the latest block; nothing while the chain does not answer."""
        if self._head is None:
            return ()
        return (gauge("aira_chain_head_block", "The last block that was read", self._head),)

    def health(self) -> Mapping[str, str]:
        """Whether the chain answers."""
        return {"chain": "does not answer" if self._head is None else ALIVE}


ROLES: Final = ("provider", "robot", "person")
"""The roles that have an account, in the order of the development chain's keys."""
ALLOWANCE: Final = 1_000 * XRT
"""What person and robot start with, wn."""
STAKE: Final = 100 * XRT
"""What the provider stakes, wn: a hundred transactions a turn."""
TIMING: Final = Timing(poll_interval=0.1)
PLAN: Final = DeploymentPlan(timeout_blocks=100)


@dataclass(frozen=True, kw_only=True)
class DevelopmentMarket:
    """The contracts on a development chain, and an account for each role."""

    deployment: Deployment
    accounts: dict[str, Account]

    def chain(self, endpoint: str | Transport, role: str) -> Chain:
        """The chain as `role` uses it, not yet open."""
        return Chain(endpoint, account=self.accounts[role], contracts=self.deployment.contracts, timing=TIMING)


@dataclass(frozen=True, kw_only=True)
class DevelopmentChain:
    """A served chain: its address, the market on it, and the folder with the keyfiles and their password."""

    url: str
    """JSON-RPC over HTTP; a WebSocket is served at the same port."""
    engine: str
    """The program that runs it, for people to read."""
    market: DevelopmentMarket
    keys: Path

    @property
    def ws_url(self) -> str:
        """The address for clients that subscribe to events, e.g. `ws://127.0.0.1:8545`."""
        return self.url.replace("http", "ws", 1)

    def describe(self, lighthouse: str = "") -> str:
        """What a person needs to use it, a line each; the `lighthouse` is that of generation 3 unless it is named."""
        lines = [
            f"chain       {self.url}",
            f"websocket   {self.ws_url}",
            f"engine      {self.engine}",
            f"lighthouse  {lighthouse or self.market.deployment.lighthouse_name}",
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


async def deploy_market(
    endpoint: str | Transport, keys: Sequence[bytes], *, plan: DeploymentPlan = PLAN
) -> DevelopmentMarket:
    """Deploy the contracts with the first of `keys`, give each role its tokens, and stake for the provider."""
    accounts = _accounts_of(keys)
    async with endpoint.in_the_past() if isinstance(endpoint, EmbeddedProvider) else nullcontext():
        deployment = await deploy(endpoint, accounts["provider"], plan=plan)
        market = DevelopmentMarket(deployment=deployment, accounts=accounts)
        async with market.chain(endpoint, "provider") as chain:
            for role in ("robot", "person"):
                await chain.tokens.transfer(accounts[role].address, ALLOWANCE)
            await chain.tokens.approve(deployment.lighthouse, STAKE)
            await chain.lighthouses.refill(deployment.lighthouse, STAKE)
    return market


async def load_market(endpoint: str, keys: Sequence[bytes]) -> DevelopmentMarket | None:
    """The market that an earlier `deploy_market` deployed with the same keys; None if they never sent anything.

    Raises `NoContracts` for a chain that holds something else, or only a part of a market.
    """
    accounts = _accounts_of(keys)
    provider = accounts["provider"]
    async with Node(endpoint, timing=TIMING) as node:
        if not await node.transaction_count(provider.address):
            return None
        async with Chain(node, account=provider) as chain:
            root = namehash("3.robonomics.eth")
            resolver = await node.read(node.contract("ENSRegistry", chain.ens).resolver(root))
            created = next(iter(await chain.lighthouses.list()), None)
            if created is None or provider.address not in (await chain.lighthouses.get(created.lighthouse)).stakes:
                raise NoContracts("lighthouse with a provider", chain.chain_id)
            deployment = Deployment(
                ens=chain.ens,
                resolver=str(resolver),
                xrt=chain.xrt,
                factory=chain.factory,
                lighthouse=created.lighthouse,
                lighthouse_name=f"{created.name}.lighthouse.3.robonomics.eth",
                block_number=await chain.block_number(),
                gas_used=0,
            )
            return DevelopmentMarket(deployment=deployment, accounts=accounts)


@asynccontextmanager
async def serve_chain(
    settings: StorageSettings,
    *,
    host: str,
    port: int,
    block_time: float | None,
    anvil: Path | None = None,
    state: Path | None = None,
) -> AsyncIterator[DevelopmentChain]:
    """Serve a chain with a market on it: by the program `anvil`, embedded without one. `block_time` is in seconds. The
    port opens when the market is there.

    The chain is gone at the end, unless anvil keeps it in the file `state`. Raises `ConfigurationError` when the port
    is taken, the keyfiles can't be written or the state can't be used; `RemoteError` when anvil ends by itself.
    """
    keys = settings.state_directory / "development"
    async with AsyncExitStack() as stack:
        if anvil is None:
            check_port(host, port)
            embedded = await stack.enter_async_context(EmbeddedChain(block_time=block_time))
            funded, engine = embedded.funded_keys, "embedded"
            market = await deploy_market(embedded.provider, funded)
            server = await stack.enter_async_context(JsonRpcServer(embedded.provider, host=host, port=port))
            url = server.url
        else:
            port = check_port(host, port)
            new = await stack.enter_async_context(_new_market(anvil, state))
            node = await stack.enter_async_context(
                serve_anvil(anvil, host=host, port=port, block_time=block_time, state=state, load=new)
            )
            url, funded, engine = node.url, node.funded_keys, f"anvil ({anvil})"
            market = await _load_or_deploy(node.url, funded, state)
        try:
            await asyncio.to_thread(_write_keyfiles, keys, funded)
        except OSError as error:
            raise ConfigurationError(
                f"can't write keyfiles to {keys}: {error.strerror}",
                hint="name another folder with --data-dir",
                code="keyfiles-not-writable",
            ) from None
        yield DevelopmentChain(url=url, engine=engine, market=market, keys=keys)


@asynccontextmanager
async def _new_market(anvil: Path, state: Path | None) -> AsyncIterator[Path | None]:
    """A file with a new chain and a market on it, which is also written to `state`; None if that has a chain already.

    Anvil listens as soon as it runs, so the contracts are deployed at a port that nobody knows. And `state` gets the
    chain when they all are there: whatever happens before, the next start begins with nothing.
    """
    if state is not None:
        if await asyncio.to_thread(state.exists):
            yield None
            return
        await asyncio.to_thread(prepare_state, state)
    with tempfile.TemporaryDirectory(prefix="aira-market-") as folder:
        new = Path(folder) / "chain.json"
        async with serve_anvil(anvil, host="127.0.0.1", port=0, block_time=None, state=new) as node:
            await deploy_market(node.url, node.funded_keys)
        if state is not None:
            await asyncio.to_thread(write_state, state, new.read_bytes())
        yield new


async def _load_or_deploy(url: str, keys: tuple[bytes, ...], state: Path | None) -> DevelopmentMarket:
    """The market of a chain that was loaded from `state`; deployed now if nobody has used that chain yet."""
    try:
        market = await load_market(url, keys)
    except NoContracts:
        raise ConfigurationError(
            f"the chain in {state} is not new, but has no market",
            hint="name another file, or remove it",
            code="market-missing",
        ) from None
    return market or await deploy_market(url, keys)


def _accounts_of(keys: Sequence[bytes]) -> dict[str, Account]:
    return {role: Account(key) for role, key in zip(ROLES, keys, strict=False)}


def _write_keyfiles(folder: Path, private_keys: tuple[bytes, ...]) -> None:
    """A keyfile per role under one random password. The keys are public knowledge: never use them on a real chain."""
    make_private_folder(folder)
    password = folder / "password"
    if not password.exists():
        write_new(password, f"{secrets.token_urlsafe(12)}\n".encode())
    for role, key in zip(ROLES, private_keys, strict=False):
        keyfile = folder / f"{role}.json"
        if not keyfile.exists():
            # The keys are public, so the keyfiles may open at once.
            write_keyfile(keyfile, key, password.read_text().strip(), iterations=1_000)


async def run_watched(path: Path, variables: Mapping[str, str]) -> None:
    """Run a Python program until cancelled, and start it again when a `.py` or `.json` file of its folder changes.

    `variables` are added to its environment. What it prints goes to stderr, each line after the program's name. One
    that has ended starts again with the next change.
    """
    while True:
        before = _times_of(path)
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-u",
            path,
            env={**os.environ, **variables},
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        assert process.stdout is not None
        showing = asyncio.create_task(_show_output(path.stem, process.stdout), name=f"output of {path.name}")
        ending = asyncio.create_task(process.wait(), name=f"end of {path.name}")
        try:
            has_ended = False
            while _times_of(path) == before:
                if ending.done() and not has_ended:
                    has_ended = True
                    await showing
                    _say(path.stem, f"ended with exit code {process.returncode}; starts again when you change a file")
                await asyncio.sleep(0.3)
            _say(path.stem, "a file has changed, so it starts again")
        finally:
            await _end_program(process)
            await asyncio.gather(showing, ending)


def _times_of(path: Path) -> dict[str, int]:
    """When the program and the files beside it were changed, in nanoseconds of Unix time."""
    found = {}
    for file in (*path.parent.glob("*.py"), *path.parent.glob("*.json")):
        with suppress(OSError):  # an editor replaces it just now
            found[file.name] = file.stat().st_mtime_ns
    return found


async def _end_program(process: asyncio.subprocess.Process) -> None:
    """End a process: in good order, or after ten seconds at once."""
    with suppress(ProcessLookupError):
        process.terminate()
        try:
            async with asyncio.timeout(10):
                await process.wait()
        except TimeoutError:
            process.kill()


async def _show_output(name: str, output: asyncio.StreamReader) -> None:
    """Show each line; one that is longer than 64 KiB in parts."""
    kept, longest = b"", 64 << 10
    while read := await output.read(longest):
        *lines, kept = (kept + read).split(b"\n")
        for line in lines:
            _say(name, line.decode(errors="replace"))
        if len(kept) > longest:
            _say(name, kept.decode(errors="replace"))
            kept = b""
    if kept:
        _say(name, kept.decode(errors="replace"))


def _say(name: str, line: str) -> None:
    print(f"{name} | {line}", file=sys.stderr, flush=True)
