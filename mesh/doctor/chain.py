"""The chain: whether its nodes answer and are on one chain, and which contracts are deployed."""

from __future__ import annotations

import time
from email.utils import parsedate_to_datetime
from typing import TYPE_CHECKING, Any, Final, TypeVar

from mesh.chain import GWEI, Chain, FeePolicy, Node, Timing
from mesh.chain.errors import NoContracts, RequestRefused
from mesh.doctor.checks import CheckResult, failed, passed, warning
from mesh.doctor.machine import RECENT, compare_chain_clock, compare_node_clock, duration

if TYPE_CHECKING:
    from collections.abc import Awaitable
    from contextlib import AsyncExitStack

    from mesh.settings import Settings

T = TypeVar("T")

QUICK: Final = Timing(request_timeout=3.0, attempts=1)
"""No retries: a node that does not answer at once is a result."""
DEVELOPMENT: Final = ("anvil", "eth-tester", "ethereumtester", "hardhat", "ganache", "aira")
"""Client names of development chains, in lower case. They mine a block only when there are transactions."""


class ChainChecks:
    """The checks of the nodes and contracts that the settings name.

    `check_chain` opens the nodes onto `stack` and `check_contracts` the contracts; the other checks need them.
    `expected` is the chain id (EIP-155), 0 for any.
    """

    def __init__(self, settings: Settings, stack: AsyncExitStack, *, expected: int = 0) -> None:
        self._settings = settings
        self._stack = stack
        self._expected = expected
        fees = FeePolicy(ceiling=round(settings.max_fee_gwei * GWEI))
        self.node = Node(settings.node, timing=QUICK, fees=fees)
        self.chain = Chain(
            self.node,
            ens=settings.ens_contract,
            factory=settings.factory_contract,
            xrt=settings.xrt_contract,
            generation=settings.generation,
            contracts=settings.contracts,
        )

    async def check_node(self, endpoint: str) -> CheckResult:
        """Whether a node answers, is synced, and gets new blocks. Raises `NodeUnreachable`."""
        async with Node(endpoint, timing=QUICK) as node:
            client = await _unless_refused(node.client_version(), otherwise="")
            block = await node.latest_header()
            syncing = await _unless_refused(node.is_syncing(), otherwise=False)
            node_time = await _server_time(endpoint)
            # By the node's clock: ours may be wrong, which another check reports.
            number, age = (
                block.number,
                (time.time() if node_time is None else node_time) - block.timestamp,
            )
            if syncing:
                return failed(
                    f"{endpoint} is still syncing at block {number:,}",
                    code="node-syncing",
                    hint="wait until it is synced; until then it does not have the newest blocks",
                )
            if is_stalled(client, number=number, age=age):
                return failed(
                    f"{endpoint} is stalled: its newest block {number:,} is {duration(age)} old",
                    code="node-stalled",
                    hint="see the node's log: check its peers and its free disk space",
                )
            old = f"{duration(max(age, 0))} old"
            about = f"chain {node.chain_id}, block {number:,}, {old}"
            return passed(f"{endpoint} answers: {about}{f', {client}' if client else ''}")

    async def check_chain(self) -> CheckResult:
        """Whether all nodes are on one chain, the expected one. Raises `WrongChain`, `NodeUnreachable`."""
        await self._stack.enter_async_context(self.node)
        found = self.node.chain_id
        if self._expected and found != self._expected:
            return failed(
                f"{self.node.endpoint} is on the chain {found}, not on {self._expected}",
                code="other-chain",
                hint="give a node of the expected chain with --web3-http-provider",
            )
        return passed(f"{found}, genesis {await self._genesis()}")

    async def check_clock(self) -> CheckResult:
        """Compare this clock with the newest block."""
        block = await self.node.latest_header()
        return compare_chain_clock(float(block.timestamp), time.time())

    async def check_contracts(self) -> CheckResult:
        """Whether registry, factory and XRT are the expected contracts. Raises `NoContracts`, `UnknownName`."""
        chain = await self._stack.enter_async_context(self.chain)
        expected, ours = self._settings.contracts, await chain.has_mesh_contracts()
        where = f"factory {chain.factory}, XRT {chain.xrt}"
        if expected == "mesh" and not ours:
            return failed(
                f"the factory or XRT does not run this project's code: {where}",
                code="not-our-contracts",
                hint="give --contracts original if they are the originals; else check --ens-contract and the names",
            )
        if expected == "original" and ours:
            return failed(
                f"these are this project's contracts, not the originals: {where}",
                code="our-contracts",
                hint="give --contracts mesh",
            )
        return passed(
            f"{'contracts of this project' if ours else 'original contracts'}: {where}",
            code="own" if ours else "original",
        )

    async def check_lighthouse(self) -> CheckResult:
        """Whether the lighthouse exists and belongs to the factory. Raises `UnknownName`."""
        name = self._settings.lighthouse_contract
        address = await self.chain.names.lighthouse(name)
        if not await self.chain.lighthouses.exists(address):
            return failed(
                f"{name} is {address}, which is not a lighthouse of this factory",
                code="not-a-lighthouse",
                hint="choose one of `aira lighthouse list` with --lighthouse-contract",
            )
        state = await self.chain.lighthouses.get(address)
        providers = len(state.stakes)
        if not providers:
            return warning(
                f"{name} ({address}) has no provider, so its orders are not matched",
                code="no-provider",
                hint="become its provider with `aira lighthouse join STAKE`, then run `aira provider`",
            )
        return passed(f"{name} is {address}, with {providers} provider{'s' if providers > 1 else ''}")

    async def check_token(self) -> CheckResult:
        """Whether the token that pays is an ERC-20 token. Raises `UnknownName`, `NoContracts`."""
        token = await self.chain.tokens.info(self._settings.erc20_token)
        if not token.total_supply:
            raise NoContracts(f"token with any supply at {token.address}", self.node.chain_id)
        return passed(f"{token.symbol or 'no symbol'}, {token.decimals} decimals, at {token.address}")

    async def _genesis(self) -> str:
        return "0x" + (await self.node.block_hash(0)).hex()[:16] + "…"


async def check_node_clock(endpoint: str) -> CheckResult:
    """Compare this clock with that of the node's machine."""
    node_time = await _server_time(endpoint)
    return (
        passed("the node does not report its time", code="no-time")
        if node_time is None
        else compare_node_clock(node_time, time.time())
    )


async def _unless_refused(asked: Awaitable[Any], *, otherwise: T) -> T:
    """A node's answer, or `otherwise` if it refuses the method, as gateways with restricted methods do."""
    try:
        answer: T = await asked
    except RequestRefused:
        return otherwise
    return answer


async def _server_time(endpoint: str) -> float | None:
    """The time of the node's machine by its HTTP header `Date` (seconds since the epoch); None without one."""
    if not endpoint.startswith("http"):
        return None
    from aiohttp import ClientError, ClientSession, ClientTimeout

    request = {"jsonrpc": "2.0", "id": 1, "method": "eth_chainId", "params": []}
    try:
        async with (
            ClientSession(timeout=ClientTimeout(total=QUICK.request_timeout)) as session,
            session.post(endpoint, json=request) as answer,
        ):
            return parsedate_to_datetime(answer.headers.get("Date", "")).timestamp()
    except (ClientError, OSError, TimeoutError, ValueError):
        return None


def nodes_of(settings: Settings) -> tuple[str, ...]:
    """The addresses of the nodes. Raises `ConfigurationError` if there is none."""
    return tuple(part.strip() for part in settings.node.split(",") if part.strip())


def is_stalled(client: str, *, number: int, age: float) -> bool:
    """Whether a newest block of this age (seconds) means that the node has stopped getting blocks. On a development
    chain it does not: a block is mined only when there are transactions."""
    return age > RECENT and number > 0 and not client.lower().startswith(DEVELOPMENT)
