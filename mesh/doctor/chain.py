"""The chain: its nodes, whether they are on one chain and alive, the contracts and whose they are."""

from __future__ import annotations

import time
from email.utils import parsedate_to_datetime
from typing import TYPE_CHECKING, Any, Final, TypeVar

from mesh.chain import GWEI, Chain, FeePolicy, Node, Timing
from mesh.chain.errors import NoContracts, RequestRefused
from mesh.chain.recognition import is_ours
from mesh.doctor.clock import RECENT, against_chain, against_node, spoken
from mesh.doctor.findings import Finding, broken, doubtful, sound

if TYPE_CHECKING:
    from collections.abc import Awaitable
    from contextlib import AsyncExitStack

    from mesh.settings import Settings

T = TypeVar("T")

QUICK: Final = Timing(request_timeout=3.0, attempts=1)
"""A node that does not answer at once is a finding."""
DEVELOPMENT: Final = ("anvil", "eth-tester", "ethereumtester", "hardhat", "ganache", "aira")
"""What the clients of development chains call themselves, in lower case: their blocks come when there is something."""


class Ledgers:
    """The nodes and the contracts that the settings name, to be checked.

    `check_chain` opens the nodes onto `stack` for the checks behind it, and `check_contracts` the contracts. `expected`
    is the chain's number (EIP-155), 0 for any.
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

    async def check_node(self, endpoint: str) -> Finding:
        """That one node answers, has all blocks, and goes on. Raises `NodeUnreachable`."""
        async with Node(endpoint, timing=QUICK) as node:
            client = await _if_told(node.web3.client_version, otherwise="")
            block = await node.web3.eth.get_block("latest")
            syncing = await _if_told(node.web3.eth.syncing, otherwise=False)
            told = await _told_time(endpoint)
            # By its own clock: ours may be wrong, which is for another check to say.
            number, age = int(block["number"]), (time.time() if told is None else told) - int(block["timestamp"])
            if syncing:
                return broken(
                    f"{endpoint} is not done with syncing: it is at block {number:,}",
                    do="wait until it is; until then it knows nothing of what happens",
                )
            if stands_still(client, number=number, age=age):
                return broken(
                    f"{endpoint} stands still: its newest block {number:,} is {spoken(age)} old",
                    do="is the node connected to others, and has it room on its disk? see its log",
                )
            old = f"{spoken(max(age, 0))} old"
            about = f"chain {node.chain_id}, block {number:,}, {old}"
            return sound(f"{endpoint} answers: {about}{f', {client}' if client else ''}")

    async def check_chain(self) -> Finding:
        """That all nodes are on one chain, the right one. Raises `WrongChain`, `NodeUnreachable`."""
        await self._stack.enter_async_context(self.node)
        found = self.node.chain_id
        if self._expected and found != self._expected:
            return broken(
                f"{self.node.endpoint} is on the chain {found}, and it should be {self._expected}",
                do="name a node of the right chain with --web3-http-provider",
            )
        return sound(f"{found}, genesis {await self._genesis()}")

    async def check_clock(self) -> Finding:
        """This clock against the newest block."""
        block = await self.node.web3.eth.get_block("latest")
        return against_chain(float(block["timestamp"]), time.time())

    async def check_contracts(self) -> Finding:
        """That registry, factory and XRT are there, and whose they are. Raises `NoContracts`, `UnknownName`."""
        chain = await self._stack.enter_async_context(self.chain)
        asked, ours = self._settings.contracts, await is_ours(chain)
        where = f"factory {chain.factory}, XRT {chain.xrt}"
        if asked == "mesh" and not ours:
            return broken(
                f"the factory or XRT is not this project's code: {where}",
                do="give --contracts original if they are the original ones; else check --ens-contract and the names",
            )
        if asked == "original" and ours:
            return broken(f"they are not the original contracts, but this project's: {where}", do="--contracts mesh")
        return sound(f"{'this project' if ours else 'the original one'}'s: {where}")

    async def check_lighthouse(self) -> Finding:
        """That the market is there, and is one of the factory's. Raises `UnknownName`."""
        name = self._settings.lighthouse_contract
        address = await self.chain.names.lighthouse(name)
        if not await self.chain.lighthouses.exists(address):
            return broken(
                f"{name} is {address}, which is no lighthouse of this factory",
                do="`aira lighthouse list` shows those that there are; name one with --lighthouse-contract",
            )
        state = await self.chain.lighthouses.get(address)
        providers = len(state.stakes)
        if not providers:
            return doubtful(
                f"{name} ({address}) has no provider: nobody brings its orders together",
                do="`aira lighthouse join STAKE` makes an account its provider; then run `aira provider`",
            )
        return sound(f"{name} is {address}, with {providers} provider{'s' if providers > 1 else ''}")

    async def check_token(self) -> Finding:
        """That the token that pays is one. Raises `UnknownName`, `NoContracts`."""
        token = await self.chain.tokens.info(self._settings.erc20_token)
        if not token.total_supply:
            raise NoContracts(f"token with any supply at {token.address}", self.node.chain_id)
        return sound(f"{token.symbol or 'without a symbol'}, {token.decimals} decimals, at {token.address}")

    async def _genesis(self) -> str:
        return "0x" + bytes((await self.node.web3.eth.get_block(0))["hash"]).hex()[:16] + "…"


async def check_node_clock(endpoint: str) -> Finding:
    """The clock of the node's machine against this one."""
    told = await _told_time(endpoint)
    return sound("the node does not tell its time") if told is None else against_node(told, time.time())


async def _if_told(asked: Awaitable[Any], *, otherwise: T) -> T:
    """What a node answers; what is taken for it where it refuses to, as gateways do that know some methods only."""
    try:
        answer: T = await asked
    except RequestRefused:
        return otherwise
    return answer


async def _told_time(endpoint: str) -> float | None:
    """The time of the node's machine, as it says in its HTTP header (seconds since 1970); None if it does not."""
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
    """The addresses of the nodes, one each. Raises `ConfigurationError` where there is none."""
    return tuple(part.strip() for part in settings.node.split(",") if part.strip())


def stands_still(client: str, *, number: int, age: float) -> bool:
    """Whether a newest block of that age (seconds) says that the node gets none any more. Only on a development chain
    blocks come no sooner than there is something for them."""
    return age > RECENT and number > 0 and not client.lower().startswith(DEVELOPMENT)
