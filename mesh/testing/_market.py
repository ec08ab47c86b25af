"""A whole market in one process for a test: router, chain, provider, robots and people, with blocks on demand."""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import shutil
import tempfile
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager, contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from mesh.agent.agent import Agent
from mesh.agent.ledger import Phase
from mesh.base.background import Background
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import log_event
from mesh.base.retry import RetryPolicy
from mesh.chain import XRT, Account, Chain, DeploymentPlan, Timing
from mesh.dev import EmbeddedChain
from mesh.dev.development import PLAN, STAKE, DevelopmentMarket, deploy_market
from mesh.errors import ClosedError, ContentError, InputError, PortUnavailable, RemoteError
from mesh.market.provider import Provider, ProviderOptions
from mesh.network import Endpoints, Network
from mesh.network.locators import free_endpoint
from mesh.recording import open_objective
from mesh.settings import Settings
from mesh.testing._clock import MarketClock
from mesh.testing._faults import Cable, full, small_disk
from mesh.testing._outcomes import JobRecording, RecordedOutcome
from schemas import cid_of_bytes, keccak256
from schemas.keys import RpcKey

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
    from typing import Unpack

    import zenoh

    from mesh.agent.agent import DemandTerms, Messages
    from mesh.agent.contracts import Contract
    from mesh.market import Match

log = logging.getLogger(__name__)

TIMING: Final = Timing(poll_interval=0.02, receipt_interval=0.01, metrics_age=0.0)
RESEND: Final = RetryPolicy(initial=0.1, ceiling=0.5)
"""Of messages without effect: everyone is near."""
ALLOWANCE: Final = 1_000 * XRT
"""What everyone starts with, wn."""
PATIENCE: Final = 30.0
"""Seconds for a contract, and for a job, by default."""
PAUSE: Final = 0.005
"""Seconds between two looks at what is waited for."""
ANY_MODEL: Final = cid_of_bytes(b"what a robot of a test does that names no model")
"""The model of orders from robots that do any."""


class _NodeLine:
    """The way to the node of a market."""

    def __init__(self, node: EmbeddedChain) -> None:
        self._node = node
        self._told: set[Callable[[Any], None]] = set()
        """Who is told of new blocks."""
        self._is_down = False

    async def make_request(self, method: str, params: Any) -> Any:
        """The node's response. Raises `ConnectionRefusedError` while the node is down."""
        if self._is_down:
            raise ConnectionRefusedError("the node is down")
        return await self._node.provider.make_request(method, params)

    def push_heads(self, on_head: Callable[[Any], None]) -> None:
        """See `PushingTransport`."""
        if not self._is_down:
            self._told.add(on_head)
            self._node.push_heads(on_head)

    def end_pushes(self, on_head: Callable[[Any], None]) -> None:
        """See `PushingTransport`."""
        self._told.discard(on_head)
        self._node.end_pushes(on_head)

    @contextmanager
    def down(self) -> Iterator[None]:
        """Meanwhile the node answers nobody."""
        self._is_down = True
        for on_head in tuple(self._told):
            self.end_pushes(on_head)
            on_head(None)
        try:
            yield
        finally:
            self._is_down = False

    def __str__(self) -> str:
        return "the node of the market"


class MarketChain(Lifecycle):
    """An Ethereum node in this process with the contracts: `async with MarketChain() as chain`, then `Market(chain)`.

    It takes a second or two to make, so share one among the markets of a run. It is not bound to an event loop. A block
    is mined for each transaction, and none in between. `plan` has the rules of its contracts, as after how many blocks
    a job that nobody ends is refunded; `node` is another node, not yet open.
    """

    title = "market chain"

    def __init__(self, plan: DeploymentPlan = PLAN, *, node: EmbeddedChain | None = None) -> None:
        self.node = node or EmbeddedChain()
        self.plan: Final = dataclasses.replace(plan, initial_supply=10**9 * XRT)
        """The rules of its contracts."""
        self.line: Final = _NodeLine(self.node)
        """The way of all programs to it."""
        self._market: DevelopmentMarket | None = None
        self._numbers = count(1)

    @property
    def market(self) -> DevelopmentMarket:
        """The contracts, and the accounts of who made them. Raises `ClosedError` outside `async with`."""
        if self._market is None:
            raise ClosedError("the market chain is not open", hint="use it inside `async with`")
        return self._market

    async def _open(self, stack: AsyncExitStack) -> None:
        await stack.enter_async_context(self.node)
        self._market = await deploy_market(self.node.provider, self.node.funded_keys, plan=self.plan)
        async with self.chain(self.market.accounts["provider"]) as chain:
            of_provider = 10**6 * XRT  # for the stakes of all its markets; the rest is for everyone
            await chain.tokens.transfer(self._bank.address, self.plan.initial_supply - of_provider)

    def chain(self, account: Account) -> Chain:
        """The chain for an account, not yet open."""
        return Chain(self.line, account=account, contracts=self.market.deployment.contracts, timing=TIMING)

    def new_account(self) -> Account:
        """An account that was never used; the accounts of each run are the same, in the same order."""
        return Account(keccak256(f"an account of tests, number {next(self._numbers)}".encode()))

    def new_name(self) -> str:
        """The label of a lighthouse that does not exist."""
        return f"test-{next(self._numbers)}"

    async def fund(self, chain: Chain, *addresses: str) -> None:
        """Give accounts `ALLOWANCE`, and 100 ETH for gas; `chain` is that of the bank."""
        for address in addresses:
            transfer = {"from": self._ether, "to": address, "value": hex(100 * 10**18)}
            await self.node.request("eth_sendTransaction", [transfer])
            await chain.tokens.transfer(address, ALLOWANCE)

    def bank(self) -> Chain:
        """The chain for the account that gives everyone what they start with, not yet open."""
        return self.chain(self._bank)

    @property
    def _bank(self) -> Account:
        return Account(self.node.funded_keys[3])

    @property
    def _ether(self) -> str:
        """The account that gives everyone ether: another one, so that nobody else uses the nonces of the bank."""
        return Account(self.node.funded_keys[4]).address


class Market(Lifecycle):
    """A market with a router, a lighthouse and a provider of its own: `async with Market() as market`.

    On `chain`, an open `MarketChain`, or on one of its own. Then `async with market.robot(agent)`, and `market.order`.

    Everything but the chain's clock is real, and in this process: messages go through Zenoh, contracts run in an EVM,
    jobs are recorded in files, in a temporary folder. Time is real, too: a handler that sleeps a second takes a second.
    Blocks are mined by transactions and by `mine`, never by a clock, so deadlines, which count blocks, do not pass.
    """

    title = "market"

    def __init__(self, chain: MarketChain | None = None) -> None:
        self._given_chain = chain
        self._customer: Agent | None = None
        self._hosts: dict[int, _Host] = {}
        """Robots that were ever in this market, by the agent's `id`."""

    async def _open(self, stack: AsyncExitStack) -> None:
        enter = stack.enter_async_context
        stack.callback(self._closed)
        self.chain = await enter(MarketChain()) if self._given_chain is None else self._given_chain
        """Where its contracts are."""
        self._folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="aira-market-")))
        self._disks = stack.enter_context(ExitStack())
        self.endpoint = await _router(stack)
        """Where it can be reached with Zenoh, as in `tcp/127.0.0.1:7447`."""
        self._first = await _block_number(self.chain.node)
        provider = await enter(self.chain.chain(self.chain.market.accounts["provider"]))
        plan = self.chain.plan
        made = await provider.lighthouses.create(
            minimal_stake=plan.minimal_stake, timeout_blocks=plan.timeout_blocks, name=self.chain.new_name()
        )
        self.lighthouse = f"{made.name}.lighthouse.3.robonomics.eth"
        """The ENS name of its lighthouse, which is new."""
        await provider.tokens.approve(made.lighthouse, STAKE)
        await provider.lighthouses.refill(made.lighthouse, STAKE)
        self._bank = await enter(self.chain.bank())
        self._ready = await _block_number(self.chain.node)
        network = await enter(Network(Endpoints(connect=(self.endpoint,))))
        self._session = network.session
        self.clock = MarketClock(self.mine, self._running)
        """The clock of the jobs here, and of the chain: `await market.clock.advance(20)`."""
        stack.enter_context(self.clock.running())
        # It makes contracts that don't pay for its gas: most tests are about something else.
        await enter(working_provider(network.session, provider, self.lighthouse, free_contracts=10**6))
        self._stack_of_people = await enter(AsyncExitStack())

    def _closed(self) -> None:
        self._customer = None
        self._hosts.clear()

    def settings(self, folder: str, **changes: Any) -> Settings:
        """Settings of a program in this market, whose files are in a folder of that name; `changes` are others."""
        return dataclasses.replace(Settings(), **self._place(folder), **changes)

    def _place(self, folder: str) -> dict[str, Any]:
        return place_of(self.endpoint, self._folder / folder, self.lighthouse, ens=self.chain.market.deployment.ens)

    async def person(self) -> Agent:
        """A new customer with 1,000 XRT, at work until the market closes."""
        account, chain = await self._account()
        agent = Agent(settings=self.settings(account.address), account=account, chain=chain, resend=RESEND)
        return await self._stack_of_people.enter_async_context(agent)

    async def balance(self, agent: Agent) -> int:
        """What an agent at work has, wn."""
        return await agent.chain.tokens.balance(agent.address)

    @asynccontextmanager
    async def robot(self, agent: Agent, *, disk: int = 0) -> AsyncIterator[Agent]:
        """Put an agent to work in this market: `async with market.robot(agent)`; yields it.

        It gets an account with 1,000 XRT, and settings that point to this market; those that say how it works stay.
        Afterwards it has its own settings again. In the same market it keeps its account and its files. With `disk`
        these are on a disk of their own of that many bytes, for `disk_full`: on Linux, as root; elsewhere the test is
        skipped.
        """
        host = self._hosts.get(id(agent))
        if host is None:
            account, chain = await self._account(agent._account)
            folder = account.address
            if disk:
                self._disks.enter_context(small_disk(self._folder / folder, disk))
                folder = f"{folder}/files"
            cable = await self._stack_of_people.enter_async_context(Cable(self.endpoint))
            place = self._place(folder) | {"connect": (cable.endpoint,)}
            host = self._hosts[id(agent)] = _Host(agent, account, chain, place, cable, self._session)
        with host.moved():
            try:
                await host.start()
                yield agent
            finally:
                await host.end()

    async def order(
        self,
        of: Agent | str,
        objective: str | Path | Messages,
        *,
        by: Agent | None = None,
        timeout: float = PATIENCE,
        **terms: Unpack[DemandTerms],
    ) -> RecordedOutcome:
        """Order a job, wait for its end, and return how it ended, with the recording; as `demand` and `outcome`."""
        return await self.outcome(await self.demand(of, objective, by=by, timeout=timeout, **terms), timeout=timeout)

    async def demand(
        self,
        of: Agent | str,
        objective: str | Path | Messages,
        *,
        by: Agent | None = None,
        timeout: float = PATIENCE,
        **terms: Unpack[DemandTerms],
    ) -> Contract:
        """Order a job and return the contract, as soon as there is one.

        `of` is an agent of this market, which alone may do it, or a model (CID), for any robot. `objective` and
        `terms` are those of `Agent.order`, as `cost="5 XRT"`. `by` is the customer, by default always the same new one.

        Raises what `Agent.demand` raises, as `DemandDeclined`; `RemoteError` (`no-contract`) after `timeout` seconds;
        and `ClosedError` for an agent that is not at work.
        """
        if isinstance(of, Agent):
            terms = {"model": of.model or ANY_MODEL, "robot": of.address, **terms}
        else:
            terms = {"model": of, **terms}
        customer = by or await self._default_customer()
        try:
            async with asyncio.timeout(timeout):
                return await customer.demand(objective, **terms)
        except TimeoutError:
            hint = "the log says what robots and the provider did; a robot needs a handler of `on_demand`, which offers"
            raise RemoteError(f"no contract within {timeout:g} s", hint=hint, code="no-contract") from None

    async def outcome(self, contract: Contract, *, timeout: float = PATIENCE) -> RecordedOutcome:
        """Wait for the end of a contract; returns how it ended, with the recording.

        `seconds` is the time from the first to the last message of the recording. Raises what `Contract.outcome`
        raises, and `RemoteError` (`no-outcome`) after `timeout` seconds.
        """
        try:
            async with asyncio.timeout(timeout):
                ended = await contract.outcome()
        except TimeoutError:
            hint = "the log says how far the job is; jobs in a market take their time, those of `run` take none"
            raise RemoteError(f"the job has not ended within {timeout:g} s", hint=hint, code="no-outcome") from None
        recording = JobRecording()
        if ended.result:
            with suppress(ContentError):  # the robot that has it is gone
                path = await contract.recording()
                recording = await asyncio.to_thread(lambda: JobRecording(open_objective(path).messages()))
        times = [message.log_time_ns for message in recording.messages] or [0]
        seconds = (max(times) - min(times)) / 1e9
        return RecordedOutcome(**msgspec.structs.asdict(ended), recording=recording, seconds=seconds)

    async def running(self, contract: Contract, *, timeout: float = PATIENCE) -> None:
        """Return once the robot of this market that has a contract works on it, or has ended it.

        Raises `InputError` (`not-here`) for a robot of elsewhere, and `RemoteError` (`not-running`) after `timeout`
        seconds.
        """
        host = next((host for host in self._hosts.values() if host.account.address == contract.robot), None)
        if host is None:
            hint = "use `async with market.robot(agent)`"
            raise InputError(f"no robot of this market has the contract {contract.address}", hint=hint, code="not-here")

        async def has_begun() -> bool:
            if not host.agent.is_open:
                return False
            job = await host.agent.parts.ledger.job(contract.address)
            return job is not None and job.phase not in (Phase.INCOMING, Phase.READY)

        if not await _until(has_begun, timeout):
            raise RemoteError(f"the job has not begun within {timeout:g} s", code="not-running")

    def _running(self) -> set[str]:
        """The jobs (addresses) that have begun and not ended."""
        at_work = [host.agent for host in self._hosts.values() if host.agent.is_open]
        return {address for agent in at_work for address in agent.runtime.executor.runs}

    async def stop(self, contract: Contract, why: str = "") -> None:
        """Stop a job as its customer, once the robot works on it. Raises as `running` and `Contract.stop` do."""
        await self.running(contract)
        await contract.stop(why)

    async def kill(self, robot: Agent) -> None:
        """End a robot as `kill -9` would: it says nothing more, and keeps only what is on its disk now.

        The process goes on, so threads of its handlers do, too. `restart` starts it again. Raises `ClosedError` for an
        agent that is not at work.
        """
        await self._host_of(robot).kill()

    async def restart(self, robot: Agent) -> None:
        """Start a robot again, with its account and its files; one that is at work is ended in good order first.

        What it failed with, as with a full disk, is logged.
        """
        host = self._hosts.get(id(robot))
        if host is None:
            raise ClosedError("the agent is not at work here", hint="use `async with market.robot(agent)`")
        try:
            await host.end()
        except Exception as error:
            log.warning("the robot had failed: %s", error, extra=log_event("robot-failed"), exc_info=True)
        await host.start()

    async def mine(self, blocks: int = 1) -> None:
        """Mine empty blocks, so that deadlines pass."""
        await self.chain.node.mine(blocks)

    async def reorg(self, depth: int) -> None:
        """Replace the last `depth` blocks, and so the transactions in them, by empty ones, one more than there were.

        Raises `InputError` (`too-deep`) for blocks from before the market was there.
        """
        head = await _block_number(self.chain.node)
        if not 0 < depth <= head - self._ready:
            why = f"a reorganisation of this market replaces 1 to {head - self._ready} blocks"
            raise InputError(why, hint="the blocks before made the market itself", code="too-deep")
        await self.chain.node.request("evm_revert", [hex(head - depth)])
        await self.chain.node.mine(depth + 1)

    @asynccontextmanager
    async def node_down(self) -> AsyncIterator[None]:
        """Meanwhile no node answers, neither the robots and people nor the provider; `mine` and `reorg` still work."""
        with self.chain.line.down():
            yield

    @asynccontextmanager
    async def partition(self, robot: Agent) -> AsyncIterator[None]:
        """Meanwhile a robot has no connection to the market's router, but to the node; afterwards it is back.

        Raises `ClosedError` for an agent that is not at work.
        """
        host = self._host_of(robot)
        host.cable.cut()
        try:
            await _until(lambda: _is(not robot.network.connected), PATIENCE)
            yield
        finally:
            host.cable.mend()
        await _until(lambda: _is(robot.network.connected), PATIENCE)

    @contextmanager
    def disk_full(self, robot: Agent) -> Iterator[None]:
        """Meanwhile no byte is left on the disk of a robot, which has one of its own: `market.robot(agent, disk=…)`.

        Raises `InputError` (`no-disk`) for one that has none, and `ClosedError` for one that is not in this market.
        """
        host = self._hosts.get(id(robot))
        if host is None:
            raise ClosedError("the agent is not at work here", hint="use `async with market.robot(agent)`")
        folder = self._folder / host.account.address
        if not folder.is_mount():
            raise InputError("the robot has no disk of its own", hint="use market.robot(agent, disk=…)", code="no-disk")
        with full(folder):
            yield

    async def _default_customer(self) -> Agent:
        if self._customer is None:
            self._customer = await self.person()
        return self._customer

    async def _account(self, given: Account | None = None) -> tuple[Account, Chain]:
        """An account that can pay, `given` or new, and its open chain."""
        account = given or self.chain.new_account()
        await self.chain.fund(self._bank, account.address)
        return account, await self._stack_of_people.enter_async_context(self.chain.chain(account))

    def _host_of(self, robot: Agent) -> _Host:
        host = self._hosts.get(id(robot))
        if host is None or not robot.is_open:
            raise ClosedError("the agent is not at work here", hint="use `async with market.robot(agent)`")
        return host


ELSEWHERE: Final = (
    "erc20_token",
    "factory_contract",
    "keyfile",
    "keyfile_password_file",
    "metrics_listen",
    "tls_ca",
    "tls_certificate",
    "tls_key",
    "xrt_contract",
)
"""Settings that would lead out of the market: accounts, names and ports of elsewhere."""


def place_of(endpoint: str, folder: Path, lighthouse: str, *, ens: str) -> dict[str, Any]:
    """The settings that make a program one of a market."""
    return {
        "connect": (endpoint,),
        "data_dir": str(folder),
        "lighthouse_contract": lighthouse,
        "ens_contract": ens,
        "poll_interval": TIMING.poll_interval,
        "playback": "at-once",
        **dict.fromkeys(ELSEWHERE, ""),
    }


@asynccontextmanager
async def working_provider(
    session: zenoh.Session,
    chain: Chain,
    lighthouse: str,
    *,
    matched: Callable[[Match], None] = lambda match: None,
    **options: Any,
) -> AsyncIterator[Provider]:
    """A provider of a lighthouse at work, with these `ProviderOptions`; `matched` is told of each match."""
    provider = Provider(session, chain, lighthouse, ProviderOptions(**options), matched=matched)
    async with provider, Background() as tasks:
        tasks.start(provider.run(), "provider of the market")
        yield provider


class _Host:
    """Where an agent is at work: in a task of its own, so that it can end without those who use it."""

    def __init__(
        self, agent: Agent, account: Account, chain: Chain, place: dict[str, Any], cable: Cable, session: zenoh.Session
    ) -> None:
        self.agent = agent
        self.account = account
        self.cable = cable
        self._chain = chain
        self._place = place
        self._session = session
        self._task: asyncio.Task[None] | None = None
        self._ending = asyncio.Event()
        self._is_killed = False

    @contextmanager
    def moved(self) -> Iterator[None]:
        """Meanwhile the agent has the settings and the account of the market."""
        agent = self.agent
        before = agent.settings, agent._account, agent._given_chain, agent._resend
        agent.settings = dataclasses.replace(agent.settings, **self._place)
        agent._account, agent._given_chain, agent._resend = self.account, self._chain, RESEND
        try:
            yield
        finally:
            agent.settings, agent._account, agent._given_chain, agent._resend = before

    async def start(self) -> None:
        """Open the agent, and return when others can reach it. Raises what opening it raises."""
        self._ending, self._is_killed, is_open = asyncio.Event(), False, asyncio.Event()
        self._task = asyncio.create_task(self._live(is_open), name=f"robot {self.account.address}")
        opened = asyncio.create_task(is_open.wait())
        try:
            await asyncio.wait([opened, self._task], return_when=asyncio.FIRST_COMPLETED)
        finally:
            opened.cancel()
        if self._task.done():
            await self.end()
        await _until_answered(self._session, self.account.address, "status")

    async def end(self) -> None:
        """Close the agent in good order. Raises what it failed with; nothing if it is not at work."""
        task, self._task = self._task, None
        if task is not None:
            self._ending.set()
            await task

    async def kill(self) -> None:
        """Close the agent, whose messages don't reach anybody any more, with the files that it has now."""
        self._is_killed = True
        await self.end()

    async def _live(self, is_open: asyncio.Event) -> None:
        folder = Path(self._place["data_dir"])
        kept, is_closed = folder.with_name(f"{folder.name}.kept"), False
        try:
            async with self.agent:
                is_open.set()
                await self._ending.wait()
                if self._is_killed:
                    # In one go: nothing of the agent runs in between.
                    self.agent.network.session.close()  # type: ignore[no-untyped-call]
                    shutil.copytree(folder, kept, ignore=_sockets)
                    is_closed = True
        except Exception as error:
            if not is_closed:
                raise
            log.debug("what a killed robot did last failed: %s", error, extra=log_event("robot-killed"))
        if is_closed:
            await asyncio.to_thread(shutil.rmtree, folder)
            kept.rename(folder)


def _sockets(folder: str, names: list[str]) -> list[str]:
    """Those of the names in a folder that are sockets: they end with their process."""
    return [name for name in names if Path(folder, name).is_socket()]


async def _router(stack: AsyncExitStack) -> str:
    """Open a router on a free port of this machine; its endpoint."""
    while True:
        endpoint = free_endpoint()
        try:
            await stack.enter_async_context(Network(Endpoints(listen=(endpoint,), mode="router")))
        except PortUnavailable:  # somebody was faster
            continue
        return endpoint


async def _is(state: bool) -> bool:
    return state


async def _block_number(node: EmbeddedChain) -> int:
    return int(await node.request("eth_blockNumber", []), 16)


async def _until(condition: Callable[[], Awaitable[bool]], seconds: float) -> bool:
    """Return True when the condition holds, False after some seconds."""
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            while not await condition():  # noqa: ASYNC110 - the ledger tells nobody
                await asyncio.sleep(PAUSE)
            return True
    return False


async def _until_answered(session: zenoh.Session, address: str, service: str) -> None:
    """Return when the router knows a service of an agent: declarations take their time to get around."""
    querier = session.declare_querier(str(RpcKey(address, service)))
    try:
        async with asyncio.timeout(PATIENCE):
            while not querier.matching_status.matching:  # type: ignore[attr-defined]  # noqa: ASYNC110
                await asyncio.sleep(PAUSE)
    finally:
        querier.undeclare()  # type: ignore[no-untyped-call]
