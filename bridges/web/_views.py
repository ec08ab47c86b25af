"""What the page shows: jobs, accounts, agents and the lighthouse, from the chain, the market and the files; what robots
say of themselves and ask for a job, which is their word; and what has been.
"""

from __future__ import annotations

import asyncio
import time
from bisect import bisect_right
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from bridges.web._access import WebError
from bridges.web._market import liability_json, result_json
from mesh.agent.contracts import refusal
from mesh.agent.hiring import PROVIDERS, asked_offer
from mesh.agent.jobs import ROBOT_STOPPED, STOPPED, read_reason
from mesh.agent.statement import read_statement
from mesh.agent.trade import are_permits_carried
from mesh.base.flood import BoundedDict, Rate, RateLimiter
from mesh.chain import NotOffered
from mesh.cli.statement import ENTRY_COLUMNS, csv_of, statement_json
from mesh.errors import AiraError, RemoteError, public_text
from mesh.network import call
from mesh.telemetry.metrics import is_healthy
from mesh.validator.verification import Claim, JobFiles, Verdict, check_end, verify
from mesh.watching import present, statuses
from mesh.watching.robots import QUOTE_TIMEOUT, accounts_of, asked_quotes
from schemas import ZERO_ADDRESS, InvalidAddress, InvalidMessage, encode, parse_address, parse_cid
from schemas.decoding import decode_json
from schemas.rpc import PermitFeeRequest
from schemas.status import BridgeStatus, Status

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from bridges.web._files import Files
    from bridges.web._market import Labels, Market, SeenJob, SeenOrder
    from bridges.web.components import WebComponents
    from mesh.agent.statement import Statement
    from mesh.cli.statement import Units
    from mesh.watching import Robot, RoleStatus
    from schemas import Liability
    from schemas.rpc import AcceptDemand, Accepted, Quote


class ViewLimits(NamedTuple):
    """What is listed in one answer."""

    listed: int = 200
    """Jobs and orders."""
    agents: int = 256
    """Agents."""
    alerts: int = 256
    """Alerts."""
    detail: int = 200
    """Characters of a detail, which a stranger may have written."""


VIEW_LIMITS: Final = ViewLimits()


def alerts_of(found: Mapping[str, RoleStatus | None], head: int) -> list[dict[str, Any]]:
    """The alerts about these addresses, at most `VIEW_LIMITS.alerts`; `head` is the last block that the page knows."""
    alerts = [
        {"agent": address, "code": code, "detail": detail[: VIEW_LIMITS.detail]}
        for address, status in found.items()
        for code, detail in _alerts(status, head)
    ]
    return alerts[: VIEW_LIMITS.alerts]


def waiting_parts(status: RoleStatus) -> list[str]:
    """The parts of an agent, a provider or a bridge that do not work now, each with its state."""
    if isinstance(status, BridgeStatus):
        return [] if status.state in ("connected", "alone") else [f"bridge: {status.state}"]
    return [f"{part}: {state}" for part, state in status.parts.items() if not is_healthy(state)]


def _alerts(status: RoleStatus | None, head: int) -> Iterator[tuple[str, str]]:
    if status is None:
        yield "silent", ""
        return
    for waiting in waiting_parts(status):
        yield "part-waits", waiting
    if isinstance(status, BridgeStatus):
        return
    if status.head + 60 < head:  # blocks that somebody may be behind the chain
        yield "behind", f"{head - status.head} blocks"
    if status.work is not None:
        store = status.work.store
        if store.quota and store.bytes > 0.95 * store.quota:  # the part of its quota that a store may use
            yield "store-full", f"{store.bytes} of {store.quota} bytes"
    if dropped := sum(sum(senders.values()) for senders in status.heaviest.values()):
        yield "drops", f"{dropped} in the last minute"


_ORDER: Final = ("created", "ready", "playing", "result", "judged", "reverted", "paid", "refunded")
"""The steps of a job, as they follow each other."""


def timeline_of(steps: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The steps in their order, none later than the next one.

    Steps have the time at which this server saw them. Those from before it started have the chain's, and that clock may
    be ahead.
    """
    latest = float("inf")
    ordered: list[dict[str, Any]] = []
    for step in sorted(steps, key=lambda step: _ORDER.index(step["kind"]), reverse=True):
        if step["at"] is not None:
            latest = min(latest, step["at"])
        ordered.append(step | {"at": None if step["at"] is None else latest})
    return ordered[::-1]


class Views:
    """Answers the page's questions about jobs, accounts, agents and the lighthouse."""

    def __init__(self, components: WebComponents, market: Market, files: Files) -> None:
        self._parts = components
        self._market = market
        self._files = files
        self._on_stops: BoundedDict[str, tuple[str, float]] = BoundedDict(1024)  # models whose `onStop` is known
        self._last_seen = LastSeen(components, market)
        self._asking = asyncio.Lock()
        self._agents: dict[str, Any] | None = None
        self._agents_at = float("-inf")
        self._alone_at = float("-inf")
        """When the router was last seen to be lost."""

    async def job(self, address: str) -> dict[str, Any]:
        """A job: terms, parties, phase, timeline. Raises `NotALiability`, `ChainError`."""
        job = await self._market.job(address)
        liability = job.liability
        await self._market.labels.learn(liability.token)
        result = self._market.results.get((address, liability.promisor))
        position = job.playback
        for step in job.steps:
            if step["at"] is None and step["block"] is not None:
                step["at"] = await self._market.time_of(step["block"])
        reason = await self._reason(job)
        order = self._market.order(job.demand)
        return {
            "liability": liability_json(liability, self._market.labels),
            "phase": "finalized" if liability.is_finalized else job.phase,
            "playback": None if position is None else {"position": position.position, "total": position.total},
            "demandHash": job.demand,
            "offerHash": job.offer,
            "refundableFrom": await self._refundable_from(job),
            "owed": str(await self._parts.chain.liabilities.owed_after(liability)),
            "timeline": timeline_of(job.steps),
            "resultMessage": None if result is None else result_json(result),
            "present": bool(await self._parts.channel.present("agent", liability.promisor)),
            "reason": reason,
            "onStop": await self._on_stop(liability.model),
            "stopped": job.stopped or _stopped_in(reason, liability),
            "private": order is not None and bool(order.robot),
        }

    async def _on_stop(self, model: str) -> str:
        """What becomes of the cost of a stopped job, by its model's description: `refund`, `paid`, or empty."""
        known, until = self._on_stops.get(model, ("", 0.0))
        if time.monotonic() < until:
            return known
        known, kept = "", 60.0  # seconds after which a description that was not available is asked for again
        with suppress(AiraError):
            description = (await self._files.model(model))["description"]
            known, kept = ("" if description is None else description.get("onStop", "refund")), float("inf")
        self._on_stops[model] = known, time.monotonic() + kept
        return known

    async def _refundable_from(self, job: SeenJob) -> int | None:
        if job.liability.is_finalized:
            return None
        with suppress(NotOffered):
            return await self._parts.chain.liabilities.refundable_from(job.liability.address)
        return None

    async def _reason(self, job: SeenJob) -> dict[str, str] | None:
        """Why a job failed, as its validator says, or its recording if that is at hand."""
        liability = job.liability
        if not liability.is_finalized or liability.is_success:
            return None
        if not liability.result:
            return {"code": "no-result", "text": ""}
        if (refused := refusal(job.reports.values())) is not None:
            return {"code": refused[1], "text": refused[0]}
        held = await asyncio.to_thread(self._parts.store.checked, liability.result)
        if held is None:
            return {"code": "recording-unavailable", "text": ""}
        with suppress(AiraError):
            reason = await asyncio.to_thread(read_reason, held)
            return {"code": reason.code, "text": reason.text}
        return None

    async def verification(self, address: str) -> dict[str, Any]:
        """The checklist of `aira verify`. Raises `NotALiability`, `ContentError`, `ChainError`."""
        liability = await self._parts.chain.liabilities.get(address)
        claim = Claim.of_contract(liability)
        message = self._market.results.get((address, liability.promisor))
        if not claim.result:
            verdict = Verdict((check_end(claim),))
        else:
            files = JobFiles(
                objective=await self._files.fetch(claim.objective),
                result=await self._files.fetch(claim.result),
                message=None if message is None else encode(message.message),
                objective_cid=claim.objective,
                result_cid=claim.result,
            )
            verdict = await self._files.in_thread(verify, claim, files, bags=True)
        return {
            "holds": verdict.holds,
            "claim": msgspec.to_builtins(claim),
            "findings": [msgspec.to_builtins(finding) for finding in verdict.findings],
        }

    async def account(self, address: str) -> dict[str, Any]:
        """Balances, allowances, the next nonce, orders and jobs of an account; whether it may order by permits.

        Raises `ChainError`.
        """
        parts, chain, market = self._parts, self._parts.chain, self._market
        eth, xrt, token, count, state, are_carried = await asyncio.gather(
            chain.tokens.eth_balance(address),
            chain.tokens.balance_and_allowance(address, chain.factory),
            chain.tokens.balance_and_allowance(address, chain.factory, token=parts.token),
            chain.node.transaction_count(address),
            chain.lighthouses.get(parts.lighthouse),
            are_permits_carried(parts.channel, chain, address),
        )
        is_counted = parts.settings.generation == 5
        nonce = str(await chain.liabilities.next_nonce(address)) if is_counted else None
        jobs = [
            job for job in reversed(market.jobs.values()) if address in (job.liability.promisee, job.liability.promisor)
        ]
        own = [order for order in market.orders() if order.verified.signer == address]
        own = [order for order in own if order.state(market.head) in ("open", "withdrawn")]
        record = records_of(jobs, parts.token).get(address, AccountRecord())
        return {
            "address": address,
            "eth": str(eth),
            "xrt": {"balance": str(xrt[0]), "allowance": str(xrt[1])},
            "token": {"balance": str(token[0]), "allowance": str(token[1])},
            "permits": parts.settings.contracts == "mesh" and are_carried,
            "nonce": nonce,
            "transactions": count,
            "stake": str(state.stakes.get(address, 0)),
            "orders": [market.posted_json(order) for order in own[-VIEW_LIMITS.listed :]],
            "record": record.json(),
            "spent": str(record.spent),
            "liabilities": [liability_json(job.liability, market.labels) for job in jobs[: VIEW_LIMITS.listed]],
        }

    async def permit_fee(self, address: str, cost: int) -> dict[str, Any]:
        """The least fee for which a provider here creates the contract of an account's order with its permit now.

        In the smallest unit of the token, as is `cost`; 0 also if no provider answers.
        """
        parts = self._parts
        wanted = PermitFeeRequest(maker=address, generation=parts.settings.generation, token=parts.token, cost=cost)
        present = {key.agent for key in await parts.channel.present("provider")}
        asked = [one for one in await self._market.providers() if one.lower() in present][:PROVIDERS]
        fees: list[int] = []

        async def ask(provider: str) -> None:
            with suppress(RemoteError):
                fees.append((await call(parts.network.session, provider, "permit-fee", wanted, timeout=2.0)).fee)

        await asyncio.gather(*map(ask, asked))
        return {"fee": str(min(fees, default=0))}

    async def lighthouse(self) -> dict[str, Any]:
        """Providers, stakes, turns, quotas. Raises `ChainError`."""
        parts = self._parts
        state, gas = await asyncio.gather(parts.chain.lighthouses.get(parts.lighthouse), parts.chain.node.gas_price())
        statuses = {agent["address"]: agent["status"] for agent in (await self.agents())["agents"]}
        return {
            "name": parts.channel.lighthouse,
            "address": state.address,
            "minimalStake": str(state.minimal_stake),
            "timeoutBlocks": state.timeout_blocks,
            "keepAliveBlock": state.keep_alive_block,
            "quotaLeft": state.quota,
            "current": state.current,
            "block": self._market.head,
            "providers": [
                {
                    "address": provider,
                    "stake": str(stake),
                    "quota": stake // state.minimal_stake if state.minimal_stake else 0,
                    "hasTurn": provider == state.current != ZERO_ADDRESS,
                    "status": statuses.get(provider),
                }
                for provider, stake in list(state.stakes.items())[: VIEW_LIMITS.agents]
            ],
            "gasPrice": str(gas),
        }

    async def agents(self) -> dict[str, Any]:
        """Who is present, with status, offers and record, and which robots are away; a few seconds old at most."""
        loop = asyncio.get_running_loop()
        async with self._asking:
            if not self._parts.network.connected:
                self._alone_at = loop.time()
            # Seconds for which a list of agents is used.
            if self._agents is None or loop.time() - self._agents_at > 3.0:
                self._agents = self._with_lost(await self._ask_agents())
                self._agents_at = loop.time()
            return self._agents

    def _with_lost(self, found: dict[str, Any]) -> dict[str, Any]:
        """With the agents that could not be found because the router is lost, or that must still find it again."""
        # Seconds in which agents have found the router again.
        if self._agents is None or asyncio.get_running_loop().time() - self._alone_at > 10.0:
            return found
        listed = {(one["role"], one["address"]): one for one in (*self._agents["agents"], *found["agents"])}
        away = [one for one in found["away"] if ("agent", one["address"]) not in listed]
        return found | {"agents": list(listed.values()), "away": away}

    async def _ask_agents(self) -> dict[str, Any]:
        parts, market = self._parts, self._market
        peers = await present(parts.channel)
        found, robots = await asyncio.gather(
            statuses(parts.network.session, parts.channel, peers[: VIEW_LIMITS.agents], timeout=2.0),
            parts.robots.present(timeout=2.0),
        )
        profiles = {robot.address: robot for robot in robots}
        self._last_seen.saw(robots)
        away = await self._last_seen.away({peer.address for peer in peers if peer.role == "agent"})
        accounts = accounts_of([*robots, *(robot for robot, _ in away.values() if robot is not None)])
        records = records_of(list(market.jobs.values()), parts.token)
        records |= {robot: _together(records[one] for one in own if one in records) for robot, own in accounts.items()}
        replaced = {address for robot in robots for address in accounts[robot.address][1:]}
        offers, models = self._offers(), self._models()
        listed = []
        for peer, status in found.items():
            profile = profiles.get(peer.address) if peer.role == "agent" else None
            own = models.get(peer.address, set()) | _own_model(status) if peer.role == "agent" else set()
            facts = {
                "role": peer.role,
                "health": _health(status),
                "status": None if status is None else decode_json(status.encode()),
                "offers": [order.json() for order in offers.get(peer.address, ())][: VIEW_LIMITS.listed],
            }
            listed.append(facts | _robot_json(peer.address, profile, own, records))
        gone = [
            {"since": since} | _robot_json(address, profile, models.get(address, set()), records)
            for address, (profile, since) in away.items()
            if address not in replaced
        ]
        alerts = alerts_of({peer.address: status for peer, status in found.items()}, parts.chain_head.head)
        return {"agents": listed, "away": gone, "unlisted": max(0, len(peers) - VIEW_LIMITS.agents), "alerts": alerts}

    def _offers(self) -> dict[str, list[SeenOrder]]:
        found: dict[str, list[SeenOrder]] = {}
        for order in self._market.orders():
            if order.message.kind == "offer" and order.state(self._market.head) == "open":
                found.setdefault(order.verified.signer, []).append(order)
        return found

    def _models(self) -> dict[str, set[str]]:
        """The models that each account offers or has worked by."""
        found = {signer: {order.message.model for order in offers} for signer, offers in self._offers().items()}
        for job in self._market.jobs.values():
            found.setdefault(job.liability.promisor, set()).add(job.liability.model)
        return found


def _stopped_in(reason: dict[str, str] | None, liability: Liability) -> dict[str, str] | None:
    """Who has stopped a job that failed, and why, by its recording."""
    parties = {STOPPED: liability.promisee, ROBOT_STOPPED: liability.promisor}
    if reason is None or reason["code"] not in parties:
        return None
    return {"by": parties[reason["code"]], "why": reason["text"].partition(": ")[2]}


def _own_model(status: RoleStatus | None) -> set[str]:
    """The model that a robot says it has: it may wait for demands without an offer."""
    with suppress(AiraError):
        if isinstance(status, Status) and status.model:
            parse_cid(status.model)
            return {status.model}
    return set()


def _health(status: RoleStatus | None) -> str:
    if status is None:
        return "silent"
    return "degraded" if waiting_parts(status) else "alive"


class AccountRecord(msgspec.Struct):
    """What the chain says of an account's jobs, as far as they were read: amounts are those of one token."""

    created: int = 0
    done: int = 0
    failed: int = 0
    open: int = 0
    earned: int = 0
    spent: int = 0

    def json(self) -> dict[str, Any]:
        return {
            "created": self.created,
            "done": self.done,
            "failed": self.failed,
            "open": self.open,
            "earned": str(self.earned),
        }


def _robot_json(
    address: str, profile: Robot | None, models: set[str], records: Mapping[str, AccountRecord]
) -> dict[str, Any]:
    """What is the same of robots that are here and that are away."""
    own = {profile.model} if profile is not None and profile.model else set()
    return {
        "address": address,
        "profile": None if profile is None else profile_json(profile),
        "models": sorted(models | own),
        "record": records.get(address, AccountRecord()).json(),
    }


def _together(records: Iterable[AccountRecord]) -> AccountRecord:
    total = AccountRecord()
    for record in records:
        for name in AccountRecord.__struct_fields__:
            setattr(total, name, getattr(total, name) + getattr(record, name))
    return total


def records_of(jobs: list[SeenJob], token: str) -> dict[str, AccountRecord]:
    """The record of each account: jobs as promisor, and what it spent as promisee in `token`."""
    found: dict[str, AccountRecord] = {}
    for job in jobs:
        liability = job.liability
        record = found.setdefault(liability.promisor, AccountRecord())
        record.created += 1
        record.open += not liability.is_finalized
        record.failed += liability.is_finalized and not liability.is_success
        record.done += liability.is_success
        if liability.is_success and liability.token == token:
            record.earned += liability.cost
            found.setdefault(liability.promisee, AccountRecord()).spent += liability.cost
    return found


QUESTIONS: Final = Rate(per_second=1.0, burst=16)
"""Questions for quotes or offers that one person may ask."""


class AwayLimits(NamedTuple):
    """What is remembered of robots that are away."""

    listed: int = 32
    """Robots that are listed: those that have had jobs, then those that were here last, …"""
    seconds: float = 30 * 86_400.0
    """… and for how long."""
    remembered: int = 256
    """Robots of which it is remembered how they presented themselves."""


AWAY_LIMITS: Final = AwayLimits()


def profile_json(robot: Robot) -> dict[str, Any]:
    """How a robot presents itself, with neither its address nor what the chain says of it."""
    facts = msgspec.to_builtins(robot)
    return {name: facts[name] for name in facts if name not in ("address", "model", "paid", "refunded")}


class LastSeen:
    """Robots that were here: how each presented itself last, and when; and when those were last heard that have had
    jobs."""

    def __init__(self, components: WebComponents, market: Market) -> None:
        self._parts = components
        self._market = market
        self._robots: BoundedDict[str, tuple[Robot, float]] = BoundedDict(AWAY_LIMITS.remembered)

    def saw(self, robots: Iterable[Robot]) -> None:
        """These robots are here now."""
        for robot in robots:
            self._robots[robot.address] = robot, time.time()

    async def away(self, present: Collection[str]) -> dict[str, tuple[Robot | None, float]]:
        """The robots (addresses) that are not `present`: their profiles, if known, and since when they are away."""
        jobs = await self._last_jobs(present)
        found: dict[str, tuple[Robot | None, float]] = {address: (None, at) for address, at in jobs.items()}
        for address, (robot, at) in self._robots.items():
            if address not in present:
                found[address] = robot, max(at, jobs.get(address, 0.0))
        oldest = time.time() - AWAY_LIMITS.seconds
        recent = [address for address, (_, since) in found.items() if since > oldest]
        recent.sort(key=lambda address: (address in jobs, found[address][1]), reverse=True)
        return {address: found[address] for address in recent[: AWAY_LIMITS.listed]}

    async def _last_jobs(self, present: Collection[str]) -> dict[str, float]:
        """When the latest job of each robot that is not `present` took its last step."""
        steps: dict[str, dict[str, Any]] = {}
        for job in reversed(self._market.jobs.values()):
            robot, is_ours = job.liability.promisor, job.liability.lighthouse == self._parts.lighthouse
            if is_ours and job.steps and robot not in present and len(steps) < AWAY_LIMITS.listed:
                steps.setdefault(robot, job.steps[-1])
        times = [step["at"] or await self._market.time_of(step["block"] or 0) or 0.0 for step in steps.values()]
        return dict(zip(steps, times, strict=True))


class Questions:
    """Asks robots for quotes, as the server's `asker`, and for offers, as people sign that."""

    def __init__(self, components: WebComponents, labels: Labels) -> None:
        self._parts = components
        self._labels = labels
        self._limiter = RateLimiter(per_sender=QUESTIONS)
        self._asking = asyncio.Semaphore(8)  # questions for quotes that are open at a time
        self._asking_offers = asyncio.Semaphore(32)  # those for offers: a robot may take half a minute

    async def quotes(self, model: str, objective: str, *, sender: str) -> list[dict[str, Any]]:
        """What the robots of a model that are present want for an objective: the cheapest first, refusals last.

        Raises `WebError` if `sender` asks too often.
        """
        self._check(sender)
        parts = self._parts
        async with self._asking:
            robots = {one.address: one for one in await parts.robots.present(model, timeout=QUOTE_TIMEOUT)}
            quotes = await asked_quotes(
                parts.network.session,
                parts.channel,
                asker=parts.asker,
                robots=[*robots],
                model=model,
                objective=objective,
            )
            return [await self._json(quote, robots[quote.agent].name) for quote in quotes]

    async def offer(self, request: AcceptDemand, *, sender: str) -> Accepted:
        """The offer of a robot for a demand that is for it alone, or its refusal.

        Raises `InvalidMessage`, `RemoteError`, and `WebError` if `sender` asks too often.
        """
        self._check(sender)
        if not request.is_signed or request.demand.signature:
            raise InvalidMessage("signature", "the maker of the order signs the request, and not yet the order")
        parse_address(request.robot)
        async with self._asking_offers:
            return await asked_offer(self._parts.network.session, request)

    def _check(self, sender: str) -> None:
        if not self._limiter.allow(sender):
            raise WebError("too many questions to robots", hint="wait a moment", code="too-many-requests")

    async def _json(self, quote: Quote, name: str) -> dict[str, Any]:
        token, validator = _address(quote.token), _address(quote.validator)
        code, detail = quote.code, quote.detail
        if not code and not token:
            code, detail = "unknown-token", "it does not say in which token"
        return {
            "agent": quote.agent,
            "name": name,
            "cost": str(int(quote.cost)),
            "token": await self._labels.learn(token or self._parts.token),
            "validator": validator,
            "start": quote.start,
            "seconds": quote.seconds,
            "until": quote.until,
            "code": public_text(code, longest=64),
            "detail": public_text(detail, longest=VIEW_LIMITS.detail),
        }


def _address(text: str) -> str:
    """The address (EIP-55) in a text of a stranger; empty if there is none."""
    try:
        return parse_address(text)
    except InvalidAddress:
        return ""


class HistoryLimits(NamedTuple):
    """What is read of the past."""

    contracts: int = 2_000
    """Contracts in a statement and in the history, the latest ones."""
    headers: int = 32
    """Blocks whose times are read for the history."""
    kept: float = 10.0
    """Seconds for which a statement is used again."""


HISTORY_LIMITS: Final = HistoryLimits()
STATEMENTS: Final = Rate(per_second=0.5, burst=16)
"""Statements that one person may ask for, beside those that are used again."""


class PastContracts:
    """Answers questions about the past."""

    def __init__(self, components: WebComponents, market: Market) -> None:
        self._parts = components
        self._market = market
        self._reading = asyncio.Lock()
        self._limiter = RateLimiter(per_sender=STATEMENTS)
        self._statements: BoundedDict[str, tuple[Statement, Units, float]] = BoundedDict(64)  # accounts

    async def statement(self, account: str, *, sender: str) -> dict[str, Any]:
        """What `aira statement --json` says of an account.

        Raises `WebError` if `sender` asks too often, `ChainError`.
        """
        return statement_json(*await self._read(account, sender))

    async def statement_csv(self, account: str, *, sender: str) -> str:
        """What `aira statement --csv` says. Raises as `statement`."""
        found, units = await self._read(account, sender)
        return csv_of(ENTRY_COLUMNS, found.entries, units)

    async def _read(self, account: str, sender: str) -> tuple[Statement, Units]:
        if (known := self._known(account)) is not None:
            return known
        if not self._limiter.allow(sender):
            raise WebError("too many statements", hint="wait a moment", code="too-many-requests")
        async with self._reading:  # one after the other: each reads the chain from its first block
            if (known := self._known(account)) is None:
                found = await read_statement(self._parts.chain, account)
                found = replace(found, entries=found.entries[-HISTORY_LIMITS.contracts :])
                units = await self._parts.chain.tokens.units(one.token for one in found.entries)
                known = found, units
                self._statements[account] = *known, time.monotonic()
            return known

    def _known(self, account: str) -> tuple[Statement, Units] | None:
        """A statement that is young enough."""
        found, units, at = self._statements.get(account, (None, {}, 0.0))
        return None if found is None or time.monotonic() - at > HISTORY_LIMITS.kept else (found, units)

    async def jobs(self, model: str = "") -> dict[str, Any]:
        """The contracts that this server knows, or those of a model (CID), the newest first."""
        known = [(block, job) for job in self._market.jobs.values() if (block := _block_of(job)) is not None]
        known = [(block, job) for block, job in known if model in ("", job.liability.model)]
        known.sort(key=lambda one: one[0], reverse=True)
        listed = known[: HISTORY_LIMITS.contracts]
        times = await self._times([block for block, _ in reversed(listed)])
        return {
            "jobs": [self._json(job, block, times) for block, job in listed],
            "truncated": len(known) > HISTORY_LIMITS.contracts,
        }

    def _json(self, job: SeenJob, block: int, times: Sequence[tuple[int, float]]) -> dict[str, Any]:
        one = job.liability
        return {
            "address": one.address,
            "model": one.model,
            "cost": str(one.cost),
            "token": self._market.labels.of(one.token),
            "state": one.state,
            "promisor": one.promisor,
            "promisee": one.promisee,
            "block": block,
            "at": time_between(times, block),
        }

    async def _times(self, blocks: Sequence[int]) -> list[tuple[int, float]]:
        """The times of a few blocks around these, which ascend.

        They stay the same while the chain grows, so that few are read again.
        """
        if not blocks:
            return []
        first, last = blocks[0], blocks[-1]
        step = 1
        while (last - first) // step > HISTORY_LIMITS.headers - 3:
            step *= 2
        chosen = sorted({first, *range(first - first % step + step, last, step), last})
        times = await asyncio.gather(*map(self._market.time_of, chosen))
        return [(block, at) for block, at in zip(chosen, times, strict=True) if at is not None]


def _block_of(job: SeenJob) -> int | None:
    """The block of its creation."""
    return next((step["block"] for step in job.steps if step["kind"] == "created"), None)


def time_between(times: Sequence[tuple[int, float]], block: int) -> float | None:
    """The time (Unix) of a block by the times of others, which ascend: exact for these, else between its neighbours.

    That of the next one outside of them, and None without any.
    """
    if not times:
        return None
    place = bisect_right(times, (block, float("inf")))
    if place in (0, len(times)):
        return times[min(place, len(times) - 1)][1]
    (before, since), (after, until) = times[place - 1 : place + 1]
    return since + (until - since) * (block - before) / (after - before)
