"""The chain and the account: whether the nodes answer and are on one chain, which contracts are deployed; the
keyfile and its password, balances, allowances, stake and turn.
"""

from __future__ import annotations

import os
import stat
import time
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

from mesh.amounts import ETH, XRT, Unit
from mesh.chain import GWEI, Account, Chain, FeePolicy, Node, NodeUnreachable, Timing
from mesh.chain.errors import FinalityNotOffered, NoContracts, RequestRefused
from mesh.chain.rpc import is_answered
from mesh.market.transactions import least_cost
from mesh.ops.doctor._machine import CLOCK_LIMITS, compare_chain_clock, compare_clock, duration
from mesh.ops.doctor.checks import CheckResult, failed, in_thread, passed, warning
from mesh.role.composition import contract_names
from mesh.settings.chains import profile_of
from schemas.address import ZERO_ADDRESS

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable
    from contextlib import AsyncExitStack

    from mesh.ops.doctor.checks import DoctorContext
    from mesh.settings import Settings
    from mesh.settings.chains import ChainProfile


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
        self.node = Node(settings.node, timing=QUICK, fees=fees, profile=settings.profile)
        self.chain = Chain(self.node, contracts=contract_names(settings))

    async def check_node(self, endpoint: str) -> CheckResult:
        """Whether a node answers, is synced, gets new blocks, and has the calls that roles need.

        Raises `NodeUnreachable`, `ConfigurationError`, `RequestRefused`.
        """
        async with Node(endpoint, timing=QUICK) as node:
            client = await _unless_refused(node.client_version(), otherwise="")
            block = await node.heads.look()
            syncing = await _unless_refused(node.is_syncing(), otherwise=False)
            node_time = await _server_time(endpoint)
            # By the node's clock: ours may be wrong, which another check reports.
            number, age = block.number, (time.time() if node_time is None else node_time) - block.timestamp
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
            await node.check_calls(ZERO_ADDRESS)
            old = f"{duration(max(age, 0))} old"
            about = f"chain {node.chain_id}, block {number:,}, {old}"
            return passed(f"{endpoint} answers: {about}{f', {client}' if client else ''}")

    async def check_chain(self) -> CheckResult:
        """Whether all nodes are on one chain, the expected one. Raises `ConfigurationError`, `NodeUnreachable`."""
        await self._stack.enter_async_context(self.node)
        found = self.node.chain_id
        if self._expected and found != self._expected:
            return failed(
                f"{self.node.endpoint} is on the chain {found}, not on {self._expected}",
                code="other-chain",
                hint="give a node of the expected chain with --web3-http-provider",
            )
        return passed(f"{found}, genesis 0x{(await self.node.block_hash(0)).hex()[:16]}…")

    async def check_profile(self) -> CheckResult:
        """Whether the chain is named, and the node is as a node of that chain."""
        node, profile = self.node, self._settings.profile
        known = profile_of(node.chain_id)
        finality = self._settings.finality
        if finality != "latest" and finality not in await self._tags():
            raise FinalityNotOffered(node.endpoint, finality, "it names no such block")
        if not profile.name and known is not None:
            return warning(
                f"the node is on {known.title}, and the settings name no chain",
                code="chain-not-named",
                hint=f'set chain = "{known.name}": confirmations, the pace of polling and deadlines then suit it',
            )
        if not profile.chain_id:
            return passed("no public chain is named" if profile.name else "no chain is named, and this is no known one")
        unlike = [text async for text in self._unlike(profile)]
        if unlike:
            return warning(
                f"the node is not as nodes of {profile.title} are: {'; '.join(unlike)}",
                code="unlike-chain",
                hint="compare with another node; it works, with more requests or other waiting times",
            )
        return passed(f"{profile.title}, and the node is as expected; finality is {finality}")

    async def _unlike(self, profile: ChainProfile) -> AsyncIterator[str]:
        """How the node differs from what is known of the chain, in words."""
        node, head = self.node, await self.node.heads.look()
        seconds = await node.heads.block_time()
        if seconds is not None and not profile.block_seconds / 2 <= seconds <= 2 * profile.block_seconds:
            yield f"a block comes every {seconds:.2g} s, not every {profile.block_seconds:g} s"
        if head.logs_bloom is None:  # they save requests for logs
            yield "its blocks have no Bloom filters"
        if profile.has_priority_fee and head.base_fee is None:
            yield "its blocks have no base fee"
        if lacking := {"safe", "finalized"} - await self._tags():
            yield f"it does not say which block is {' or '.join(sorted(lacking, reverse=True))}"
        try:
            first = max(0, head.number - profile.log_range + 1)
            await node.logs(first, head.number, addresses=[ZERO_ADDRESS], topics=["0x" + "00" * 32])
        except RequestRefused:
            yield f"it refuses the logs of {profile.log_range:,} blocks at once"

    async def _tags(self) -> set[str]:
        """Which of `safe` and `finalized` the node has a block for."""
        found = set()
        for tag in ("safe", "finalized"):
            try:
                if await self.node.request("eth_getBlockByNumber", tag, False):
                    found.add(tag)
            except (RequestRefused, NodeUnreachable) as error:
                if not is_answered(error):
                    raise
        return found

    async def check_clock(self) -> CheckResult:
        """Compare this clock with the newest block."""
        block = await self.node.heads.look()
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
        tokens = self.chain.tokens
        address = await tokens.address(self._settings.erc20_token)
        if not await tokens.supply(address):
            raise NoContracts(f"token with any supply at {address}", self.node.chain_id)
        unit = await tokens.unit(address)
        return passed(f"{unit.symbol}, {unit.decimals} decimals, at {address}")


async def check_node_clock(endpoint: str) -> CheckResult:
    """Compare this clock with that of the node's machine."""
    node_time = await _server_time(endpoint)
    if node_time is None:
        return passed("the node does not report its time", code="no-time")
    tolerated = CLOCK_LIMITS.apart + 1  # it has whole seconds
    return compare_clock(node_time, time.time(), whose="the node's", tolerated=tolerated)


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
    return age > CLOCK_LIMITS.comparable and number > 0 and not client.lower().startswith(DEVELOPMENT)


SECRETS: Final = tuple(map(Path, ("/run/secrets", "/run/credentials", "/secrets")))
"""Folders in which containers and systemd units get secrets; no other user can read them."""


class ApprovalLimits(NamedTuple):
    """How far the account's approvals are looked for."""

    blocks: int = 10_000
    """Blocks in one search."""
    searches: int = 20
    """Such searches, from the newest block backwards."""
    seconds: float = 5.0
    """After which no further one is begun."""
    spenders: int = 20
    """Spenders whose allowances are asked for, of each token."""


APPROVAL_LIMITS: Final = ApprovalLimits()
AMPLE: Final = 20
"""Number of transactions for which the account should have ETH."""


class AccountChecks:
    """The checks of the account in the settings' keyfile. All but the keyfile's need an open chain."""

    def __init__(self, context: DoctorContext, chain_checks: ChainChecks) -> None:
        self._context = context
        self._chain_checks = chain_checks
        self.address = ""
        """EIP-55; empty until the keyfile is decrypted."""

    async def check_keyfile(self) -> CheckResult:
        """Whether the password decrypts the keyfile, and no other user can read either.

        Raises `KeyfileError`.
        """
        files = self._context.settings.keyfile_and_password()
        self.address = (await in_thread(Account.from_keyfile, *files)).address
        readable = [path for path in files if _is_read_by_others(path)]
        if readable:
            names = " and ".join(map(str, readable))
            hint = f"chmod 600 {' '.join(map(str, readable))}"
            return warning(
                f"{self.address}, but other users of this machine can read {names}", code="keyfile-readable", hint=hint
            )
        return passed(f"{self.address}, the password decrypts {files[0]}")

    async def check_ether(self) -> CheckResult:
        """Whether the account can pay gas. Raises `FeeTooHigh`."""
        node = self._chain_checks.node
        balance = await node.eth_balance(self.address)
        node.fees.offer(await node.gas_market())
        one = await least_cost(node)
        count = balance // one if one else AMPLE
        shown = f"{self.address} has {_amount(balance, ETH)}"
        if count >= AMPLE:
            return passed(f"{shown}: gas for {'more than 1,000' if count > 1000 else f'{count:,}'} transactions")
        if count >= 1:
            return warning(
                f"{shown}: gas for only {count} transactions", code="little-gas", hint="send it ETH to pay for gas"
            )
        if self._context.role == "agent":
            return warning(
                f"{shown}: not enough gas for a transaction",
                code="no-gas",
                hint="send it ETH if it should approve fees or cancel jobs; working and being paid needs none",
            )
        if self._context.role == "validator" and self._context.settings.validator_contract:
            return passed(f"{shown}: judging for a contract needs none")
        return failed(
            f"{shown}: not enough gas for a transaction",
            code="no-gas",
            hint=f"send it at least {at_least(AMPLE * one, ETH)}",
        )

    async def check_tokens(self) -> CheckResult:
        """Whether the account has tokens to pay with."""
        chain, token, coin = self._chain_checks.chain, self._context.settings.erc20_token, await self._coin()
        balance = await chain.tokens.balance(self.address, token=token)
        shown = f"{self.address} has {_amount(balance, coin)}"
        if owed := await chain.liabilities.owed(token, self.address):
            return warning(
                f"{shown}, and is owed {_amount(owed, coin)} that the token refused to pay",
                code="tokens-owed",
                hint="`aira liability claim ADDRESS` takes it, with the address of a liability that was to pay it",
            )
        if balance or self._context.role != "person":
            return passed(shown)
        return failed(
            f"{shown}: it can't pay for a job",
            code="no-tokens",
            hint=f"send it {coin.symbol}, for example with `aira xrt transfer`",
        )

    async def check_allowance(self) -> CheckResult:
        """Whether the factory may transfer the cost of a job, or the account can pay gas to allow it."""
        chain, coin = self._chain_checks.chain, await self._coin()
        allowed = await chain.tokens.allowance(self.address, chain.factory, token=self._context.settings.erc20_token)
        if allowed:
            return passed(f"the factory may transfer {_amount(allowed, coin)}")
        node = chain.node
        approve = "`aira xrt approve factory AMOUNT`"
        if await node.eth_balance(self.address) < await least_cost(node):
            return failed(
                f"the factory may not transfer {coin.symbol} of {self.address}, which has no ETH to approve it",
                code="no-allowance",
                hint=f"send it ETH for gas; then `aira demand` approves the cost of a job, or use {approve}",
            )
        return warning(
            f"the factory may not transfer {coin.symbol} of {self.address} yet",
            code="no-allowance",
            hint=f"`aira demand` and agents approve the cost of each job; to approve more, use {approve}",
        )

    async def check_other_allowances(self) -> CheckResult:
        """Whether others than this deployment may transfer the account's tokens, such as the factory of an earlier one.

        Looks at XRT and the token that pays, and at whom the account approved in the latest blocks.
        """
        chain, found = self._chain_checks.chain, list[str]()
        since, hints = await chain.block_number() + 1, list[str]()
        for token in dict.fromkeys((chain.xrt, await chain.tokens.address(self._context.settings.erc20_token))):
            spenders, oldest = await self._approved(token)
            since, unit = min(since, oldest), await chain.tokens.unit(token)
            for spender in sorted(spenders - {chain.factory})[: APPROVAL_LIMITS.spenders]:
                allowed = await chain.tokens.allowance(self.address, spender, token=token)
                if allowed and not await chain.lighthouses.exists(spender):
                    found.append(f"{spender} {_amount(allowed, unit)}")
                    option = "" if token == chain.xrt else f" --token {token}"
                    hints.append(f"`aira xrt approve {spender} 0{option}`")
        looked = f"its approvals since block {since:,} were looked at, no earlier ones and no other tokens"
        if not found:
            return passed(f"nobody else may transfer tokens of {self.address}; {looked}")
        return warning(
            f"others may transfer tokens of {self.address}: {', '.join(found)}; {looked}",
            code="other-allowances",
            hint=f"take back what you don't know, or gave to old contracts: {', '.join(hints)}",
        )

    async def _approved(self, token: str) -> tuple[set[str], int]:
        """Whom the account approved in the latest blocks, and the first of these blocks. Raises `RequestRefused`."""
        chain, found, span = self._chain_checks.chain, set[str](), APPROVAL_LIMITS.blocks
        oldest, until = await chain.block_number() + 1, time.monotonic() + APPROVAL_LIMITS.seconds
        for _ in range(APPROVAL_LIMITS.searches):
            if not oldest or time.monotonic() > until:
                break
            first = max(0, oldest - span)
            try:
                found |= await chain.tokens.approved(self.address, first, oldest - 1, token=token)
            except RequestRefused:
                if span == 1:
                    raise
                span = max(1, span // 4)
            else:
                oldest = first
        return found, oldest

    async def check_stake(self) -> CheckResult:
        """Whether the account has a stake at its lighthouse. Raises `NoStake`."""
        from mesh.market.transactions import NoStake

        chain, name = self._chain_checks.chain, self._context.settings.lighthouse_contract
        state = await chain.lighthouses.get(name)
        if self.address not in state.stakes:
            raise NoStake(self.address, name, minimal_stake=state.minimal_stake)
        stake = state.stakes[self.address]
        count = stake // state.minimal_stake if state.minimal_stake else 0
        return passed(f"{_amount(stake, XRT)} at {name}: {count:,} transaction{'' if count == 1 else 's'} per turn")

    async def check_turn(self) -> CheckResult:
        """Whose turn it is at the lighthouse."""
        chain = self._chain_checks.chain
        state = await chain.lighthouses.get(self._context.settings.lighthouse_contract)
        block, providers = await chain.contract_block(), list(state.stakes)
        if state.current == self.address:
            return passed(f"its own, with {state.quota:,} transactions left", code="own-turn")
        place = f"{providers.index(state.current) + 1} of {len(providers)}" if state.current in providers else "left"
        active = f"last active {block - state.keep_alive_block:,} blocks ago"
        active = active if state.keep_alive_block else "not active yet"
        may = "may send now" if await chain.lighthouses.is_turn(state.address, self.address) else "waits for its turn"
        return passed(f"{state.current} ({place}), {active}; this account {may}", code="other-turn")

    async def check_validator(self) -> CheckResult:
        """Whether the account may judge for the contract of the settings. Raises `ChainError` if not."""
        from mesh.validator.runtime import court_of

        contract = self._context.settings.validator_contract
        if not contract:
            return passed(f"{self.address} judges for itself (generation 3)", code="own-account")
        court = await court_of(self._chain_checks.chain, self.address, contract)
        return passed(f"{self.address} is a juror of {court.contract}: {court.quorum} of {court.jurors} must agree")

    async def _coin(self) -> Unit:
        return await self._chain_checks.chain.tokens.unit(self._context.settings.erc20_token)


def _amount(count: int, coin: Unit) -> str:
    """An amount of the smallest unit, in whole tokens with a readable number of decimals."""
    return coin.show(count - count % _last_digit(coin))


def at_least(count: int, coin: Unit) -> str:
    """The same, rounded up, so that the shown amount suffices."""
    last = _last_digit(coin)
    return coin.show(-(-count // last) * last)


def _last_digit(coin: Unit) -> int:
    """The least amount that is shown of a token: ether has eighteen decimals."""
    return int(10 ** max(0, coin.decimals - 9))


def _is_read_by_others(path: Path) -> bool:
    if os.name != "posix" or any(map(path.is_relative_to, SECRETS)):
        return False
    return bool(path.stat().st_mode & (stat.S_IRGRP | stat.S_IROTH))
