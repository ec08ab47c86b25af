"""The signer: an agent with a person's key behind two sockets. What programs order is judged by the person's policy.

    asked ──► refused                                         nothing is kept but the log
      ├─────► needs-consent ──► denied, expired               nothing was signed
      └─────► ordering ──► waiting ──► accepted ──► running ──► done, refunded, stopped
                 └──► failed  └──► withdrawn, expired

An order is judged, its cost is bound in the budget, and both are in the log and on the disk, before anything is signed.
The hash of each demand is on the disk before that is sent: a signer that was killed finds its order again by it, on the
market or on the chain, and signs no second one while the first may still become a contract.
"""

from __future__ import annotations

import asyncio
import logging
import os
import secrets
import socket
import struct
import time
from collections import Counter
from contextlib import asynccontextmanager, nullcontext, suppress
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from weakref import WeakValueDictionary

import msgspec
from aiohttp import web

from mesh.agent.agent import Agent
from mesh.agent.contracts import LiabilityReverted
from mesh.agent.hiring import DemandDeclined
from mesh.agent.jobs import STOPPED
from mesh.agent.orders import ORDER_LIFETIME, OrderClosed, OrderExpired, OrderState, OtherRobot
from mesh.amounts import ETH
from mesh.base.background import Background
from mesh.base.database import DISK_ERRORS, LedgerUnusable
from mesh.base.door import DoorLimits
from mesh.base.flood import Rate, RateLimiter
from mesh.base.http_server import HttpServer
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import log_event
from mesh.base.private_files import held_alone, make_private_folder
from mesh.base.retry import Backoff
from mesh.chain import InsufficientTokens
from mesh.errors import (
    AiraError,
    ChainError,
    ClosedError,
    ConfigurationError,
    ContentError,
    InputError,
    RemoteError,
    public_text,
)
from mesh.network import Pump, PumpLimits, ServiceFailed
from mesh.recording import GENEROUS, Played, described_line, json_messages, messages_in, open_objective, pack
from mesh.role.program import RESEND
from mesh.settings.chains import LONGEST_ORDER
from mesh.signer import protocol
from mesh.signer._answers import (
    SIGNER_ANSWER_LIMITS,
    amount,
    described_model,
    found_robot,
    message_lines,
    plain,
    recorded,
    strangers,
    value_text,
)
from mesh.signer._kept import Budget, BudgetHold, ConsentRecord, KeptJob, SignerLog, log_files, time_text, verify_log
from mesh.signer.policy import Decision, parse_policy, read_policy_file
from mesh.signer.protocol import DOOR, OWNER, Job, SignerError, SignerFailure
from mesh.validator.verification import Claim, JobFiles, check_end, verify
from schemas import parse_address, parse_cid, parse_key
from schemas.address import keccak256
from schemas.cid import is_cid
from schemas.decoding import InvalidData, decode_json
from schemas.errors import InvalidCid
from schemas.keys import LiabilityTopicKey, job_selector
from schemas.messages import lasting_hash
from schemas.model import InvalidDescription
from schemas.payloads import payload_type

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
    from contextlib import AsyncExitStack
    from pathlib import Path

    import zenoh

    from mesh.agent.contracts import Contract, Progress
    from mesh.agent.trade import Order
    from mesh.base.retry import RetryPolicy
    from mesh.chain import Account, Chain
    from mesh.recording import Objective
    from mesh.settings import Settings
    from mesh.validator.verification import Finding
    from schemas import Demand, Offer
    from schemas.model import ModelDescription
    from schemas.rpc import Quote

log = logging.getLogger(__name__)

CONNECTIONS: Final = MappingProxyType({protocol.DOOR_SOCKET: 512, protocol.OWNER_SOCKET: 64})
"""Connections to each socket at once."""
AT_ONCE: Final = frozenset({"stop_job", "withdraw", *OWNER})
"""Operations that are worked on at once, whatever else is: what ends a job, and those of the owner."""


class SignerRequestLimits(NamedTuple):
    """What programs may ask of the signer."""

    rate: Rate = Rate(per_second=30.0, burst=300)
    """Requests on one socket."""
    at_a_time: int = 16
    """Requests that are worked on, without those in `AT_ONCE` and those that only wait for a job to change."""
    waiting: int = 256
    """Requests that wait for a place, and as many that wait for a job to change."""


REQUEST_LIMITS: Final = SignerRequestLimits()


class SignedOrderLimits(NamedTuple):
    """What programs may order."""

    rate: Rate = Rate(per_second=1.0, burst=300)
    """Orders, also those that are refused: each stays in the log and in the budget's file."""
    consents: int = 20
    """Orders that wait for a person's yes."""
    messages: int = 10_000
    """Messages of an order: those of a file may be more than a request holds."""


SIGNED_ORDER_LIMITS: Final = SignedOrderLimits()
TICK: Final = 0.5
"""Seconds between two changes of a job that are not kept, new values and progress: robots say how often these come."""
CHOICES: Final = ("cheapest", "first")
AGAIN: Final = "order again, with a new key"
ORDER_EXPIRED: Final = SignerFailure(
    code="order-expired", message="no contract was made in time", next=f"{AGAIN}, perhaps for more"
)


class Signer(Lifecycle):
    """Serves the operations of `protocol` for an account: `async with Signer(settings, policy) as signer`.

    `policy` is the path of the policy's file. `account` and `chain` (open) are used instead of those that the settings
    name; `clock` is the time of day. Raises `ConfigurationError` for a policy that can't be used, and if another signer
    runs in the same folder.
    """

    title = "signer"

    def __init__(
        self,
        settings: Settings,
        policy: Path,
        *,
        account: Account | None = None,
        chain: Chain | None = None,
        resend: RetryPolicy = RESEND,
        clock: Callable[[], float] = time.time,
    ) -> None:
        if account is None:
            settings.keyfile_and_password()
        # Nobody on the network makes this account sign, and it does no jobs.
        self.settings = replace(settings, enable_executor=False, open_services=False)
        self._policy_path = policy
        self._clock = clock
        self.agent = Agent(settings=self.settings, account=account, chain=chain, resend=resend)
        self.folder = protocol.signer_folder(settings)
        self._keys: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()
        self._changed: dict[str, asyncio.Event] = {}
        self._ticks: dict[str, int] = {}
        """How often a job has changed in ways that are not kept."""
        self._ticking: set[str] = set()
        """Jobs of which such a change is about to be counted."""
        self._progress: dict[str, protocol.JobProgress] = {}
        self._latest: dict[str, dict[str, protocol.LatestValue]] = {}
        self._places = asyncio.Semaphore(REQUEST_LIMITS.at_a_time)
        self._waiting: Counter[bool] = Counter()
        self._orders = RateLimiter(per_sender=SIGNED_ORDER_LIMITS.rate)

    @property
    def door(self) -> Path:
        return self.folder / protocol.DOOR_SOCKET

    @property
    def owner(self) -> Path:
        return self.folder / protocol.OWNER_SOCKET

    async def _open(self, stack: AsyncExitStack) -> None:
        data = await asyncio.to_thread(read_policy_file, self._policy_path)
        await asyncio.to_thread(make_private_folder, self.folder)
        running = ConfigurationError(
            "another signer runs with this data folder",
            hint="one account has one signer; stop the other one",
            code="signer-running",
        )
        stack.enter_context(held_alone(self.folder / "lock", running))
        await stack.enter_async_context(self.agent)
        parts = self.agent.parts
        self._unit = await parts.chain.tokens.unit(self.settings.erc20_token)
        self._token = await parts.chain.names.address(self.settings.erc20_token)
        self.policy = parse_policy(data, unit=self._unit, name=self._policy_path.name)
        place = parts.directory / "signer"
        self.budget = Budget(place / "budget.sqlite", clock=self._clock)
        self.budget.open(self.agent.address)
        stack.callback(self.budget.close)
        self.log = SignerLog(place / "log", parts.signer, self.budget)
        self.log.open()
        self.since = self.budget.now()
        self.log.add("started", policy=self.policy.hash)
        if (behind := self.budget.clock_behind) > 60:
            hint = "if the earlier time was wrong, `aira mcp policy use` takes the clock as it is"
            facts = log_event("clock-behind", seconds=round(behind))
            log.warning("the clock is %.0f s behind the latest time in the budget: %s", behind, hint, extra=facts)
        await self.budget.sync()
        self._tasks = await stack.enter_async_context(Background())
        for job in self.budget.open_jobs():
            if job.state != "needs-consent":
                self._start(job)
        for consent in self.budget.consents():
            self._expire_later(consent)
        for name, operations in ((protocol.DOOR_SOCKET, DOOR), (protocol.OWNER_SOCKET, OWNER)):
            await self._serve(stack, name, operations)

    async def _serve(self, stack: AsyncExitStack, name: str, operations: Mapping[str, protocol.Operation]) -> None:
        app = web.Application(client_max_size=protocol.LARGEST_REQUEST)
        limiter = RateLimiter(per_sender=REQUEST_LIMITS.rate)
        app.router.add_post("/v1/{operation}", partial(self._answer, operations, limiter))
        path = self.folder / name
        path.unlink(missing_ok=True)  # of an earlier run: the folder is locked
        listening = socket.socket(socket.AF_UNIX)
        stack.callback(listening.close)
        before = os.umask(0o177)
        try:
            listening.bind(str(path))
        except OSError as error:
            hint = (
                "its path is too long: name a folder with a shorter one with --data-dir" if len(str(path)) > 90 else ""
            )
            why = error.strerror or str(error)
            raise ConfigurationError(f"can't listen on {path}: {why}", hint=hint, code="socket-unusable") from None
        finally:
            os.umask(before)
        stack.callback(partial(path.unlink, missing_ok=True))
        at_once = CONNECTIONS[name]
        limits = DoorLimits(connections=at_once, per_address=at_once)
        server = HttpServer(app, "", bound=listening, refusal=_refusal_of(at_once), limits=limits)
        await stack.enter_async_context(server)

    async def _answer(
        self, operations: Mapping[str, protocol.Operation], limiter: RateLimiter, request: web.Request
    ) -> web.Response:
        """Answer a request, also one that can't be answered."""
        try:
            _check_peer(request)
            name = request.match_info["operation"]
            if name not in operations:
                known = name in DOOR or name in OWNER
                why = "this socket has no such operation" if known else "there is no such operation"
                raise SignerError(why, hint="only the owner's socket has it" if known else "", code="unknown-operation")
            if not limiter.allow("job" if name == "job" else ""):  # whoever follows jobs can still stop them
                raise SignerError("too many requests", hint="wait a moment", code="too-many-requests")
            try:
                asked = decode_json(await request.read(), operations[name].request)
            except InvalidData as error:
                raise SignerError(f"not a request for {name}: {plain(str(error))}", code="invalid-request") from None
            found = await self._work_on(name, asked)
        except AiraError as error:
            return _answered(protocol.ErrorAnswer(error=failure_of(error)), status=400)
        except web.HTTPRequestEntityTooLarge:
            return _answered(protocol.ErrorAnswer(error=failure_of(protocol.RequestTooLarge())), status=413)
        except web.HTTPException:
            raise
        except Exception:
            log.exception("a request failed", extra=log_event("signer-request-failed", path=request.path))
            said = SignerFailure(code="error", message="the signer failed; see its log")
            return _answered(protocol.ErrorAnswer(error=said), status=500)
        return _answered(found)

    async def _work_on(self, name: str, asked: Any) -> protocol.SignerAnswer:
        method: Callable[[Any], Awaitable[protocol.SignerAnswer]] = getattr(self, f"_do_{name}")
        if name in AT_ONCE:
            return await method(asked)
        is_look = name == "job"
        if self._waiting[is_look] >= REQUEST_LIMITS.waiting:
            raise SignerError("too many requests wait", hint="wait a moment", code="too-many-requests")
        self._waiting[is_look] += 1
        try:
            async with nullcontext() if is_look else self._places:
                return await method(asked)
        finally:
            self._waiting[is_look] -= 1

    async def _do_find_robots(self, asked: protocol.FindRobots) -> protocol.FoundRobots:
        wanted = asked.text.casefold()
        robots = [
            robot
            for robot in await self.agent.robots(asked.model)
            if wanted in robot.name.casefold() or wanted in robot.about.casefold() or wanted == robot.address.casefold()
        ]
        found = []
        for robot in robots[: asked.limit]:
            model = await self._description(robot.model) if is_cid(robot.model) else None
            is_allowed = self.policy.refusal_of(robot.model, robot.address) is None
            found.append(found_robot(robot, model, is_allowed=is_allowed))
        return protocol.FoundRobots(robots=tuple(found), more=len(robots) - len(found))

    async def _do_describe_model(self, asked: protocol.DescribeModel) -> protocol.DescribedModel:
        cid = await self._model(asked.model)
        return described_model(cid, await self._description(cid), self.policy.rules_for(cid))

    async def _do_quote(self, asked: protocol.AskQuotes) -> protocol.FoundQuotes:
        model = await self._model(asked.model)
        objective, allowed = await self._objective(model, asked.messages, asked.objective, "")
        quotes, declined = [], []
        spending, now = self.budget.spending(), self.budget.now()
        for quote in await self.agent.quotes(model, objective):
            author = f"robot {quote.agent}"
            name = strangers(self.agent.parts.robots.name(quote.agent), author)
            if quote.code or quote.token != self._token:
                code, why = (quote.code, quote.detail) if quote.code else ("other-token", "it wants another token")
                declined.append(
                    protocol.DeclinedQuote(robot=quote.agent, name=name, code=_word(code), why=strangers(why, author))
                )
                continue
            decision = self.policy.decide(quote.cost, spending, now)
            if allowed is not None and quote.agent not in allowed:
                why = "the policy does not allow this robot"
                decision = Decision("refused", "robot-not-allowed", why)
            quotes.append(
                protocol.FoundQuote(
                    robot=quote.agent,
                    name=name,
                    cost=amount(self._unit, int(quote.cost)),
                    start_seconds=quote.start,
                    duration_seconds=quote.seconds or None,
                    valid_until=time_text(now + await self._seconds_until(quote.until)),
                    verdict=decision.verdict,
                    code=decision.code,
                    why=decision.why,
                )
            )
        return protocol.FoundQuotes(quotes=tuple(quotes), declined=tuple(declined), objective=objective)

    async def _do_order(self, asked: protocol.OrderJob) -> Job:
        lock = self._keys.setdefault(asked.idempotency_key, asyncio.Lock())
        async with lock:
            digest = request_digest(asked)
            known = self.budget.job_of_key(asked.idempotency_key)
            if known is not None and known.digest != digest:
                raise SignerError(
                    "another order was made with this idempotency_key",
                    hint="use a new key for another order",
                    code="idempotency-conflict",
                )
            if known is not None:
                return await self._shown(known)
            if not self._orders.allow(""):
                raise SignerError("too many orders", hint="wait a moment", code="too-many-requests")
            try:
                return await self._judge(asked, digest)
            except AiraError as error:
                facts = {"model": asked.model[:64], "robot": asked.robot[:64], "cost": asked.cost, "digest": digest}
                self.log.add("refused", code=error.code, key=_key(asked), policy=self.policy.hash, **facts)
                raise

    async def _judge(self, asked: protocol.OrderJob, digest: str) -> Job:
        """The job of an order that the policy allows, or allows with a consent. Raises `SignerError`, `AiraError`."""
        policy = self.policy
        model = await self._model(asked.model)
        robot = asked.robot if asked.robot in CHOICES else parse_address(asked.robot)
        named = "" if robot in CHOICES else robot
        cost = self._unit.parse(asked.cost)
        _require(policy.decide(cost, self.budget.spending(), self.budget.now()))
        objective, robots = await self._objective(model, asked.messages, asked.objective, named)
        await self.agent.runtime.require_fit(objective, model)
        description = await self._description(model)
        if policy is not self.policy:
            raise SignerError("the policy was changed meanwhile", hint="ask again", code="policy-changed")
        # From here on until it is written down nothing else happens in this process.
        now = self.budget.now()
        decision = policy.decide(cost, self.budget.spending(), now)
        _require(decision)
        job = KeptJob(
            id=f"job-{secrets.token_hex(8)}",
            request=msgspec.structs.replace(asked, messages=()),  # they are in the objective
            digest=digest,
            state="ordering",
            objective=objective,
            model=model,
            cost=cost,
            robot=named,
            robots=None if robots is None else tuple(sorted(robots)),
            until=now + asked.deadline_seconds,
            on_stop="" if description is None else description.on_stop,
            created=now,
            changed=now,
        )
        facts = {"model": model, "objective": objective, "robot": robot, "cost": cost, "policy": policy.hash}
        if decision.verdict == "needs-consent":
            if len(self.budget.consents()) >= SIGNED_ORDER_LIMITS.consents:
                raise SignerError(
                    f"{SIGNED_ORDER_LIMITS.consents} orders wait for a person's yes already",
                    hint="wait until the owner has answered them",
                    code="too-many-consents",
                )
            consent = ConsentRecord(
                id=f"consent-{secrets.token_hex(8)}",
                job=job.id,
                digest="",
                created=now,
                expires=now + policy.valid,
                why=decision.why,
            )
            job = msgspec.structs.replace(job, state="needs-consent", consent=consent.id)
            consent = msgspec.structs.replace(consent, digest=self._consent_digest(job, consent.id))
            self.log.add("consent-needed", job=job.id, key=_key(asked), consent=consent.id, note=asked.note, **facts)
            job = self.budget.put(job, consent)
            await self.budget.sync()
            self._expire_later(consent)
        else:
            self.log.add("allowed", job=job.id, key=_key(asked), note=asked.note, **facts)
            job = self.budget.put(msgspec.structs.replace(job, hold=BudgetHold.OPEN))
            await self._begin(job)
        return await self._shown(job)

    async def _objective(
        self, model: str, messages: Sequence[protocol.Message], cid: str, robot: str
    ) -> tuple[str, frozenset[str] | None]:
        """The CID of an order's objective, which is in the store, and the robots that the policy allows it for.

        What counts are the messages that were decoded from the file, as robots get it. Raises `SignerError`.
        """
        if bool(messages) == bool(cid):
            hint = "give either messages, or the CID of an objective"
            raise SignerError("an order has messages, or an objective", hint=hint, code="invalid-request")
        _require(self.policy.refusal_of(model, robot))
        if cid:
            parse_cid(cid)
            objective = await self.agent.examine(cid)
            return cid, await asyncio.to_thread(self._allowed_robots, model, objective, robot)
        found = self.policy.rules_allowing(model, ((one.topic, one.value) for one in messages), robot)
        if isinstance(found, Decision):  # before anything is made of them
            raise _refusal(found)
        description = await self._description(model)
        return await asyncio.to_thread(self._packed, model, messages, description, robot)

    def _packed(
        self, model: str, messages: Sequence[protocol.Message], description: ModelDescription | None, robot: str
    ) -> tuple[str, frozenset[str] | None]:
        """Make an objective of messages, judge what is in it, and put it into the store. Blocks on the disk."""
        import tempfile
        from pathlib import Path

        with tempfile.TemporaryDirectory(prefix="aira-signer-") as folder:
            path = Path(folder) / "objective.mcap"
            lines = [described_line(one.topic, one.value, description) for one in messages]
            pack(messages_in(lines), path)
            allowed = self._allowed_robots(model, open_objective(path), robot)
            return self.agent.parts.store.put_file(path), allowed

    def _allowed_robots(self, model: str, objective: Objective, robot: str) -> frozenset[str] | None:
        """The robots for which the policy allows an objective; None for any. Raises `SignerError`. Blocks."""
        if objective.count > SIGNED_ORDER_LIMITS.messages:
            why = f"an order has at most {SIGNED_ORDER_LIMITS.messages:,} messages, not {objective.count:,}"
            raise SignerError(why, hint="order less at a time", code="value-not-allowed")
        try:
            found = self.policy.rules_allowing(model, json_messages(objective), robot)
        except InvalidData as error:
            raise SignerError(f"a message can't be judged: {plain(str(error))}", code="field-not-allowed") from None
        if isinstance(found, Decision):
            raise _refusal(found)
        named = [rule.robots for rule in found]
        return None if None in named else frozenset[str]().union(*(one for one in named if one is not None))

    async def _begin(self, job: KeptJob) -> None:
        """Order an allowed job, whose cost is bound from here on, also if the disk fails.

        Nothing leaves before its hash is on the disk, either.
        """
        try:
            await self.budget.sync()
        finally:
            self._start(job)

    def _start(self, job: KeptJob) -> None:
        self._tasks.start(self._see_through(job.id), f"signer: {job.id}")

    async def _see_through(self, job_id: str) -> None:
        """See a job to its end, whatever fails meanwhile."""
        backoff = Backoff()
        while (job := self.budget.job(job_id)) is not None and (not job.is_over or job.hold is BudgetHold.OPEN):
            try:
                if job.contract:
                    await self._follow(job)
                elif job.order:
                    await self._find_again(job)
                else:
                    await self._place(job)
            except ClosedError:  # the signer ends
                return
            except (RemoteError, LedgerUnusable) as error:
                facts = log_event("job-waits", job=job_id, code=error.code)
                log.warning("job %s waits: %s", job_id, error, extra=facts)
                await backoff.wait()
            except AiraError as error:
                if (job := self.budget.job(job_id)) is None or job.order or job.contract:
                    log.warning("job %s: %s", job_id, error, extra=log_event("job-waits", job=job_id, code=error.code))
                    await backoff.wait()
                else:
                    await self._end(job, "failed", hold=BudgetHold.NONE, error=failure_of(error))
            except DISK_ERRORS as error:
                facts = log_event("job-waits", job=job_id, code=type(error).__name__)
                log.warning("job %s waits for the disk: %s", job_id, type(error).__name__, extra=facts)
                await backoff.wait()

    async def _place(self, job: KeptJob) -> None:
        """Sign the order for the robot that is chosen, and post it. Nothing of it has been signed, or left here."""
        declined: list[tuple[str, str, str]] = []
        for robot, cost in await self._candidates(job, declined):
            if self.budget.now() >= job.until:
                break
            job = self._put(job, robot=robot, cost=cost)
            blocks = await self._blocks(job.until - self.budget.now())
            try:
                order = await self.agent.order(
                    job.objective,
                    model=job.model,
                    cost=cost,
                    robot=robot,
                    lifetime=blocks,
                    on_signed=partial(self._signed, job.id),
                )
            except DemandDeclined as error:  # before it was posted
                declined += [(one.agent, one.code, one.detail) for one in error.declines]
            except ServiceFailed:
                declined.append((robot, "silent", "it does not answer"))
            except InsufficientTokens as error:
                job = self._put(self._current(job), order="")  # it was not posted
                said = SignerFailure(
                    code=error.code, message="the account lacks the money", next="put more into the account"
                )
                await self._end(job, "failed", hold=BudgetHold.NONE, error=said)
                return
            else:
                job = self._put(self._current(job), state="waiting")
                self.log.add("ordered", job=job.id, robot=robot, cost=cost, order=order.hash)
                await self._wait(job, order)
                return
        await self._end(job, "failed", hold=BudgetHold.NONE, error=no_robot(declined))

    async def _candidates(self, job: KeptJob, declined: list[tuple[str, str, str]]) -> list[tuple[str, int]]:
        """The robots that may get a job, the best first, with what each is paid."""
        chosen, most = job.request.robot, self._unit.parse(job.request.cost)
        quotes = await self.agent.quotes(job.model, job.objective)
        fitting: list[Quote] = []
        for quote in quotes:
            if chosen not in CHOICES and quote.agent != job.robot:
                continue
            if quote.code:
                declined.append((quote.agent, quote.code, quote.detail))
            elif job.robots is not None and quote.agent not in job.robots:
                declined.append((quote.agent, "robot-not-allowed", "the policy does not allow this robot"))
            elif quote.token != self._token or quote.cost > most:
                declined.append((quote.agent, "too-expensive", f"it wants {self._unit.show(quote.cost)}"))
            else:
                fitting.append(quote)
        if chosen == "first":
            fitting.sort(key=lambda quote: (quote.start + quote.seconds, quote.cost))
        if chosen not in CHOICES and not fitting:
            return [(parse_address(chosen), most)]  # it names no price, or is asked for its offer all the same
        return [(quote.agent, int(quote.cost)) for quote in fitting]

    async def _signed(self, job_id: str, demand: Demand | Offer) -> None:
        """Keep what was signed for a job, before anybody gets it."""
        job = self.budget.job(job_id)
        assert job is not None
        self._put(job, order=lasting_hash(demand), deadline=demand.deadline)
        await self.budget.sync()

    async def _wait(self, job: KeptJob, order: Order) -> None:
        """Wait until an order is a contract, or can't become one any more."""
        try:
            contract = await order.contract(on_progress=partial(self._heard, job.id))
        except OrderExpired:
            await self._end(self._current(job), "expired", hold=BudgetHold.NONE, error=ORDER_EXPIRED)
        except OrderClosed as error:
            if error.liability:
                await self._accepted(job, await self.agent.contract(error.liability))
            else:
                await self._outlast(self._current(job))
        except OtherRobot as error:
            await self._accepted(job, await self.agent.contract(error.liability))
        else:
            await self._accepted(job, contract)

    async def _outlast(self, job: KeptJob) -> None:
        """Wait until an order that was withdrawn can't become a contract any more: then it binds no money."""
        job = self._withdrawn(job)
        parts = self.agent.parts
        while parts.chain_head.contract_block < job.deadline:
            if found := await self._contract_of(job):
                await self._accepted(job, await self.agent.contract(found))
                return
            await asyncio.sleep(max(0.5, self.settings.poll_interval))
        if found := await self._contract_of(job):
            await self._accepted(job, await self.agent.contract(found))
        else:
            await self._end(job, "withdrawn", hold=BudgetHold.NONE)

    async def _find_again(self, job: KeptJob) -> None:
        """Find the order of a job that an earlier run has signed, and go on with it.

        If it is neither here nor on the chain, it never left: orders are kept before they are sent.
        """
        parts = self.agent.parts
        await parts.chain_head.reached(await parts.chain.block_number())
        for order in self.agent.orders(OrderState.OPEN, OrderState.WITHDRAWN):
            if order.kind == "demand" and lasting_hash(order.message) == job.order:
                if order.state is OrderState.WITHDRAWN:
                    await self._outlast(job)
                else:
                    await self._wait(job if job.state == "waiting" else self._put(job, state="waiting"), order)
                return
        if found := await self._contract_of(job):
            await self._accepted(job, await self.agent.contract(found))
        elif job.state in ("ordering",) and parts.chain_head.contract_block < job.deadline:
            await self._place(self._put(job, order="", deadline=0))
        elif parts.chain_head.contract_block >= job.deadline:
            await self._end(job, "expired", hold=BudgetHold.NONE, error=ORDER_EXPIRED)
        else:
            await asyncio.sleep(max(0.5, self.settings.poll_interval))

    async def _contract_of(self, job: KeptJob) -> str:
        """The contract (address) that the order of a job has become; empty if there is none."""
        from schemas import decode

        for payload, liability in await self.agent.parts.ledger.contracts("demand"):
            demand: Any = decode(payload)
            if lasting_hash(demand) == job.order:
                return liability
        return ""

    async def _accepted(self, job: KeptJob, contract: Contract) -> None:
        job, liability = self._current(job), contract.liability
        facts: dict[str, Any] = {"robot": liability.promisor, "cost": int(liability.cost)}
        self.log.add("contract", job=job.id, contract=contract.address, **facts)
        job = self._put(job, state="accepted", hold=BudgetHold.SPENT, contract=contract.address, **facts)
        await self.budget.sync()
        await self._follow(job, contract)

    async def _follow(self, job: KeptJob, contract: Contract | None = None) -> None:
        contract = await self.agent.contract(job.contract) if contract is None else contract
        async with self._latest_values(job):
            try:
                outcome = await contract.outcome(on_progress=partial(self._heard, job.id))
            except LiabilityReverted as error:
                await self._end(self._current(job), "failed", hold=BudgetHold.NONE, error=failure_of(error))
                return
        job = self._current(job)
        if outcome.success:
            await self._end(job, "done", result=outcome.result)
            return
        is_stopped = job.stopped_why is not None or outcome.code == STOPPED
        said = SignerFailure(
            code=_word(outcome.code) or "failed",
            message=f"the job {'was stopped' if is_stopped else 'failed'}, and its cost came back",
            next="see the recording" if outcome.result else f"{AGAIN}, perhaps from another robot",
            from_strangers=strangers(outcome.reason, f"robot {job.robot}") if outcome.reason else None,
        )
        await self._end(job, "stopped" if is_stopped else "refunded", result=outcome.result, error=said)

    async def _end(self, job: KeptJob, state: protocol.JobState, **changes: Any) -> None:
        error: SignerFailure | None = changes.get("error")
        self.log.add("ended", job=job.id, state=state, code="" if error is None else error.code)
        self._put(job, state=state, **changes)
        self._progress.pop(job.id, None)
        await self.budget.sync()

    def _current(self, job: KeptJob) -> KeptJob:
        """A job as it is kept now."""
        return self.budget.job(job.id) or job

    def _put(self, job: KeptJob, *consents: ConsentRecord, **changes: Any) -> KeptJob:
        kept = self.budget.put(msgspec.structs.replace(job, **changes), *consents)
        self._tell(job.id)
        return kept

    def _tell(self, job_id: str) -> None:
        """Wake those who wait for a job to change."""
        if (changed := self._changed.pop(job_id, None)) is not None:
            changed.set()

    def _heard(self, job_id: str, progress: Progress) -> None:
        """Something was heard of a job or its order."""
        job = self.budget.job(job_id)
        if job is None or job.is_over:
            return
        if progress.kind == "playing":
            self._progress[job_id] = protocol.JobProgress(position=progress.position, total=progress.total)
            if job.state == "accepted":
                self._put(job, state="running")
                return
        self._tick_soon(job_id)

    def _tick_soon(self, job_id: str) -> None:
        """Count a change that is not kept, with all others of the next `TICK` seconds."""
        if job_id not in self._ticking:
            self._ticking.add(job_id)
            asyncio.get_running_loop().call_later(TICK, self._tick, job_id)

    def _tick(self, job_id: str) -> None:
        self._ticking.discard(job_id)
        self._ticks[job_id] = self._ticks.get(job_id, 0) + 1
        self._tell(job_id)

    @asynccontextmanager
    async def _latest_values(self, job: KeptJob) -> AsyncIterator[None]:
        """Keep the latest values that the robot publishes in a job, meanwhile."""
        limiter = RateLimiter(per_sender=Rate(per_second=20.0, burst=40))
        while len(self._latest) > 256:
            self._latest.pop(next(iter(self._latest)))

        def read(sample: zenoh.Sample) -> Played | None:
            try:
                key = parse_key(str(sample.key_expr))
            except AiraError:
                return None
            if not isinstance(key, LiabilityTopicKey) or not limiter.allow(""):
                return None
            now = time.time_ns()
            return Played(key.topic, sample.payload.to_bytes(), now, now, 0, payload_type(str(sample.encoding)))

        async def take(pump: Pump[Played]) -> None:
            async for message in pump:
                with suppress(AiraError):
                    self._keep_latest(job, message)

        async with (
            Pump(
                self.agent.network.session,
                job_selector(job.robot, job.contract),
                read,
                limits=PumpLimits(256, 4 << 20, payload=SIGNER_ANSWER_LIMITS.payload),
                drops=self.agent.drops,
            ) as pump,
            Background() as tasks,
        ):
            tasks.start(take(pump), "latest values")
            yield

    def _keep_latest(self, job: KeptJob, message: Played) -> None:
        kept = self._latest.setdefault(job.id, {})
        if message.topic in kept or len(kept) < 16:
            text, _ = value_text(message, f"robot {job.robot}")
            moment = time_text(message.log_time_ns / 1e9)
            kept[message.topic] = protocol.LatestValue(topic=plain(message.topic, 200), value=text, time=moment)
            self._tick_soon(job.id)

    async def _do_job(self, asked: protocol.ReadJob) -> Job:
        job = self._known(asked.job_id)
        if asked.wait_seconds:
            with suppress(TimeoutError):
                async with asyncio.timeout(asked.wait_seconds):
                    while self._revision(job) == asked.revision and not job.is_over:
                        await self._changed.setdefault(job.id, asyncio.Event()).wait()
                        job = self._known(asked.job_id)
        return await self._shown(self._known(asked.job_id))

    async def _do_jobs(self, asked: protocol.ListJobs) -> protocol.Jobs:
        shown = [await self._shown(job) for job in self.budget.jobs(asked.limit)]
        return protocol.Jobs(jobs=tuple(msgspec.structs.replace(job, latest=()) for job in shown))

    async def _do_stop_job(self, asked: protocol.StopJob) -> Job:
        job = self._known(asked.job_id)
        if job.is_over:
            return await self._shown(job)
        if not job.contract:
            raise SignerError("the job is no contract yet", hint="withdraw it instead", code="not-a-contract")
        if job.stopped_why is None:  # whoever asks again is in the log already
            self.log.add("stop-asked", job=job.id, why=plain(asked.why))
            job = self._put(job, stopped_why=asked.why)
        contract = await self.agent.contract(job.contract)
        await contract.stop(plain(asked.why, 200) or "a program of the customer stopped it")
        return await self._shown(self._current(job))

    async def _do_withdraw(self, asked: protocol.WithdrawJob) -> Job:
        job = self._known(asked.job_id)
        if job.is_over:
            return await self._shown(job)
        if job.contract:
            raise SignerError("the job is a contract already", hint="stop it instead", code="already-a-contract")
        if job.state == "needs-consent":
            consent = self.budget.consent(job.consent)
            void = () if consent is None else (msgspec.structs.replace(consent, answer="void"),)
            return await self._shown(self._withdrawn(job, *void))
        for order in self.agent.orders():
            if job.order and order.kind == "demand" and lasting_hash(order.message) == job.order:
                await order.withdraw()
                return await self._shown(self._withdrawn(self._current(job)))
        raise SignerError("the order is being sent", hint="try again in a moment", code="order-under-way")

    def _withdrawn(self, job: KeptJob, *consents: ConsentRecord) -> KeptJob:
        """The job that was taken back; one that has ended, or become a contract all the same, stays what it is."""
        if job.is_over or job.contract:
            return job
        self.log.add("withdrawn", job=job.id)
        return self._put(job, *consents, state="withdrawn")

    async def _do_recording(self, asked: protocol.ReadRecording) -> protocol.Recording:
        job = self._known(asked.job_id)
        if not job.result:
            hint = "wait until it has ended" if not job.is_over else ""
            raise SignerError("the job has no recording", hint=hint, code="no-recording")
        path = await self.agent.fetch(job.result)
        author = f"robot {job.robot}"
        return await asyncio.to_thread(lambda: recorded(open_objective(path, GENEROUS), job.result, author, asked))

    async def _do_verify(self, asked: protocol.VerifyJob) -> protocol.Verification:
        job = self._known(asked.job_id)
        if not job.contract:
            raise SignerError("the job is no contract", code="not-a-contract")
        claim = Claim.of_contract(await self.agent.chain.liabilities.get(job.contract))
        findings: tuple[Finding, ...] = (check_end(claim),)
        if claim.result:
            files = JobFiles(
                objective=await self.agent.fetch(claim.objective),
                result=await self.agent.fetch(claim.result),
                objective_cid=claim.objective,
                result_cid=claim.result,
            )
            findings = tuple((await asyncio.to_thread(verify, claim, files, bags=True)).findings)
        author = f"robot {job.robot}"
        return protocol.Verification(
            holds=all(finding.holds is not False for finding in findings),
            checks=tuple(
                protocol.JobCheck(name=one.name, holds=one.holds, detail=strangers(one.detail, author))
                for one in findings
            ),
        )

    async def _do_balance(self, asked: protocol.ReadBalance) -> protocol.AccountFunds:
        tokens, policy, now = self.agent.chain.tokens, self.policy, self.budget.now()
        coin, token = await asyncio.gather(
            tokens.eth_balance(self.agent.address), tokens.balance(self.agent.address, token=self._token)
        )
        spending = self.budget.spending()
        return protocol.AccountFunds(
            account=self.agent.address,
            coin=amount(ETH, coin),
            token=amount(self._unit, token),
            per_job=amount(self._unit, policy.per_job),
            hour_left=amount(self._unit, max(0, policy.per_hour - spending.hour)),
            day_left=amount(self._unit, max(0, policy.per_day - spending.day)),
            jobs=spending.jobs,
            jobs_at_a_time=policy.jobs_at_a_time,
            is_open_now=policy.hours is None or policy.hours.contain(now),
        )

    async def _do_statement(self, asked: protocol.ReadStatement) -> protocol.AccountStatement:
        found = await self.agent.statement(asked.first, asked.last)
        own = [entry for entry in reversed(found.entries) if entry.token == self._token]
        listed = own[: asked.limit]
        return protocol.AccountStatement(
            account=found.account,
            entries=tuple(
                protocol.StatementEntry(
                    time=time_text(entry.time),
                    contract=entry.liability.address,
                    model=entry.model,
                    robot=entry.liability.promisor,
                    state=entry.liability.state,
                    earned=amount(self._unit, entry.earned),
                    spent=amount(self._unit, entry.spent),
                )
                for entry in listed
            ),
            earned=amount(self._unit, sum(entry.earned for entry in own)),
            spent=amount(self._unit, sum(entry.spent for entry in own)),
            more=len(own) - len(listed),
        )

    async def _do_consents(self, asked: protocol.ListConsents) -> protocol.Consents:
        return protocol.Consents(consents=tuple([await self._consent(one) for one in self.budget.consents()]))

    async def _consent(self, consent: ConsentRecord) -> protocol.Consent:
        job = self._known(consent.job)
        asked, author = job.request, f"program with the key {_key(job.request)}"
        path = await self.agent.fetch(job.objective)
        shown, more = await asyncio.to_thread(lambda: message_lines(json_messages(open_objective(path)), author))
        description = await self._description(job.model)
        name = self.agent.parts.robots.name(job.robot) if job.robot else ""
        return protocol.Consent(
            id=consent.id,
            job_id=job.id,
            model=job.model,
            title=None if description is None else strangers(description.title, f"model {job.model}"),
            robot=job.robot or asked.robot,
            name=strangers(name, f"robot {job.robot}") if name else None,
            cost=amount(self._unit, job.cost),
            objective=job.objective,
            messages=tuple(shown),
            more=more,
            why=consent.why,
            note=strangers(asked.note, author),
            created=time_text(consent.created),
            expires=time_text(consent.expires),
        )

    async def _do_approve(self, asked: protocol.ApproveOrder) -> Job:
        consent = self._open_consent(asked.id)
        job = self._known(consent.job)
        if job.state != "needs-consent" or self._consent_digest(job, consent.id) != consent.digest:
            raise SignerError("the order is not the one that this consent was for", code="consent-void")
        now = self.budget.now()
        _require(self.policy.decide(job.cost, self.budget.spending(besides=job.id), now, has_consent=True))
        self.log.add("approved", job=job.id, consent=consent.id, cost=job.cost, policy=self.policy.hash)
        job = self._put(
            job,
            msgspec.structs.replace(consent, answer="yes"),
            state="ordering",
            hold=BudgetHold.OPEN,
            until=now + job.request.deadline_seconds,
        )
        await self._begin(job)
        return await self._shown(job)

    async def _do_deny(self, asked: protocol.DenyOrder) -> Job:
        consent = self._open_consent(asked.id)
        job = self._known(consent.job)
        self.log.add("denied", job=job.id, consent=consent.id)
        said = SignerFailure(
            code="consent-denied", message="the owner did not allow the order", next="don't order it again"
        )
        job = self._put(job, msgspec.structs.replace(consent, answer="no"), state="denied", error=said)
        await self.budget.sync()
        return await self._shown(job)

    async def _do_answer_consent(self, asked: protocol.AnswerConsent) -> Job:
        if not self.policy.consent_by_client:
            hint = "the owner answers with `aira mcp approve`, or on the page"
            raise SignerError("the policy takes no consents from programs", hint=hint, code="consent-not-by-client")
        self.log.add("answered-by-client", consent=asked.id, allow=asked.allow)
        if asked.allow:
            return await self._do_approve(protocol.ApproveOrder(id=asked.id))
        return await self._do_deny(protocol.DenyOrder(id=asked.id))

    def _open_consent(self, consent_id: str) -> ConsentRecord:
        """A consent that can be answered now. Raises `SignerError`."""
        consent = self.budget.consent(consent_id)
        if consent is None:
            raise SignerError(
                "no order waits for this consent", hint="`aira mcp approve` lists them", code="consent-unknown"
            )
        hint = f"the program must {AGAIN}"
        if consent.answer == "void" and (error := self._known(consent.job).error) is not None:
            raise SignerError(error.message, hint=hint, code=error.code)
        if consent.answer:
            was = {"yes": "allowed", "no": "denied"}.get(consent.answer, "taken back")
            raise SignerError(f"the order was {was} before", hint="each consent is used once", code="consent-used")
        if self.budget.now() >= consent.expires:
            raise SignerError("nobody allowed the order in time", hint=hint, code="consent-expired")
        return consent

    def _expire_later(self, consent: ConsentRecord) -> None:
        self._tasks.start(self._expire(consent.id), f"signer: {consent.id}")

    async def _expire(self, consent_id: str) -> None:
        while (consent := self.budget.consent(consent_id)) is not None and not consent.answer:
            if (left := consent.expires - self.budget.now()) > 0:
                await asyncio.sleep(min(left + 0.01, 1.0))
                continue
            job = self._known(consent.job)
            self.log.add("consent-expired", job=job.id, consent=consent.id)
            said = SignerFailure(code="consent-expired", message="nobody allowed the order in time", next=AGAIN)
            self._put(job, msgspec.structs.replace(consent, answer="void"), state="expired", error=said)

    def _consent_digest(self, job: KeptJob, consent: str) -> str:
        """The hash of all that a person says yes to."""
        named = (consent, job.id, job.digest, job.model, job.objective, job.robot, job.robots, job.cost)
        return keccak256(b"aira consent\0" + msgspec.json.encode((*named, self.policy.hash))).hex()

    async def _do_log(self, asked: protocol.ReadLog) -> protocol.LogEntries:
        entries = self.log.entries(asked.first, asked.limit)
        return protocol.LogEntries(
            entries=tuple(
                protocol.LogEntry(number=one.number, time=time_text(one.time), event=one.event, facts=one.facts)
                for one in entries
            ),
            total=self.budget.log_head().last,
        )

    async def _do_verify_log(self, asked: protocol.VerifyLog) -> protocol.LogVerified:
        await self.budget.sync()
        head, folder = self.budget.log_head(), self.log.folder
        fault = "there is no log"
        if await asyncio.to_thread(log_files, folder):
            fault = await asyncio.to_thread(
                verify_log, folder, self.agent.address, head, latest=lambda: self.budget.log_head().last
            )
        return protocol.LogVerified(
            holds=not fault, entries=head.last - head.first + 1, head=head.hash, signer=self.agent.address, fault=fault
        )

    async def _do_policy(self, asked: protocol.ReadPolicy) -> protocol.PolicyInUse:
        return protocol.PolicyInUse(hash=self.policy.hash, words=self.policy.words(), since=time_text(self.since))

    async def _do_use_policy(self, asked: protocol.UsePolicy) -> protocol.PolicyInUse:
        try:
            data = await asyncio.to_thread(read_policy_file, self._policy_path)
            self.policy = parse_policy(data, unit=self._unit, name=self._policy_path.name)
        except ConfigurationError as error:
            raise SignerError(str(error), hint=error.hint, code=error.code) from None
        self.budget.trust_clock()
        self.since = self.budget.now()
        self.log.add("policy-used", policy=self.policy.hash)
        said = SignerFailure(code="policy-changed", message="the owner changed the policy", next=AGAIN)
        for consent in self.budget.consents():
            job = self._known(consent.job)
            self._put(job, msgspec.structs.replace(consent, answer="void"), state="denied", error=said)
        await self.budget.sync()
        return await self._do_policy(protocol.ReadPolicy())

    def _known(self, job_id: str) -> KeptJob:
        if (job := self.budget.job(job_id)) is None:
            raise SignerError("there is no such job", hint="`jobs` lists them", code="unknown-job")
        return job

    def _revision(self, job: KeptJob) -> int:
        return job.revision + self._ticks.get(job.id, 0)

    async def _shown(self, job: KeptJob) -> Job:
        consent = self.budget.consent(job.consent) if job.state == "needs-consent" else None
        name = self.agent.parts.robots.name(job.robot) if job.robot else ""
        needed = None
        if consent is not None:
            expires, command = time_text(consent.expires), f"aira mcp approve {consent.id}"
            needed = protocol.NeededConsent(
                id=consent.id,
                why=consent.why,
                expires=expires,
                command=command,
                by_client=self.policy.consent_by_client,
            )
        return Job(
            job_id=job.id,
            state=job.state,
            revision=self._revision(job),
            model=job.model,
            objective=job.objective,
            robot=job.robot,
            name=strangers(name, f"robot {job.robot}") if name else None,
            cost=amount(self._unit, job.cost),
            created=time_text(job.created),
            changed=time_text(job.changed),
            note=job.request.note,
            contract=job.contract,
            result=job.result,
            on_stop=job.on_stop,
            progress=self._progress.get(job.id),
            latest=tuple(self._latest.get(job.id, {}).values()),
            consent=needed,
            error=job.error,
        )

    async def _model(self, named: str) -> str:
        """The CID of a model that is named by its CID or name."""
        try:
            return await self.agent.chain.names.model(named)
        except InvalidCid as error:
            why = f"{plain(named, 64)!r} is no model's CID or name"
            raise SignerError(why, hint="find_robots has the CIDs", code=error.code) from None

    async def _description(self, model: str) -> ModelDescription | None:
        with suppress(InvalidDescription):
            return await self.agent.runtime.models.find(model)
        return None

    async def _blocks(self, seconds: float) -> int:
        """How many blocks make so many seconds, at most: for how long an order is valid."""
        block_time = await self.agent.chain.node.contract_blocks.seconds(ORDER_LIFETIME.measured)
        blocks = int(seconds / block_time) if block_time else int(seconds)
        return max(1, min(blocks, self.settings.deadline_limit))

    async def _seconds_until(self, block: int) -> float:
        block_time = await self.agent.chain.node.contract_blocks.seconds(ORDER_LIFETIME.measured)
        left = block - self.agent.parts.chain_head.contract_block
        return max(0.0, min(left * (block_time or 1.0), LONGEST_ORDER))


def request_digest(asked: protocol.OrderJob) -> str:
    """The hash of what an order asks for: equal for equal orders, whatever their notes are."""
    plain_order = msgspec.structs.replace(asked, note="")
    return keccak256(msgspec.json.encode(plain_order, order="deterministic")).hex()


def no_robot(declined: list[tuple[str, str, str]]) -> SignerFailure:
    """Why no robot got a job: who declined it, with which codes."""
    codes = "; ".join(f"{robot}: {_word(code)}" for robot, code, _ in declined[:5])
    said = next((strangers(detail, f"robot {robot}") for robot, _, detail in declined if detail), None)
    is_unpriced = any(code == "no-price" for _, code, _ in declined)
    named = "name the address of a robot without a price in `robot`, " if is_unpriced else ""
    return SignerFailure(
        code="no-robot-fits",
        message=f"no robot takes the job ({codes or 'none of this model answers'})",
        next=f"see quote; {named}order for more, or from another robot, with a new key",
        from_strangers=said,
    )


def failure_of(error: AiraError) -> SignerFailure:
    """An error as programs get it: what a stranger may have written in it is marked."""
    if isinstance(error, SignerError):
        said = error.from_strangers
        return SignerFailure(code=error.code, message=plain(str(error), 500), next=error.hint, from_strangers=said)
    text = plain(public_text(error), 500)
    if isinstance(error, InputError) and error.code != "objective-unfit":
        return SignerFailure(code=error.code, message=text, next=plain(public_text(error.hint)))
    kinds = (
        (ChainError, "the chain refused, or did not answer"),
        (ContentError, "a file is not available"),
        (InputError, "the order does not fit the model"),
        (RemoteError, "the other side failed, or did not answer"),
    )
    message = next((words for kind, words in kinds if isinstance(error, kind)), "the signer can't do that")
    return SignerFailure(
        code=error.code, message=message, from_strangers=protocol.StrangersText(text=text, author="others")
    )


def _check_peer(request: web.Request) -> None:
    """Raise `SignerError` unless the process at the other end runs as this user."""
    transport = request.transport
    peer = None if transport is None else transport.get_extra_info("socket")
    if not hasattr(socket, "SO_PEERCRED"):
        return  # the file's rights keep others out
    if peer is None:
        raise SignerError("the connection is lost", code="wrong-user")
    _, uid, _ = struct.unpack("3i", peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i")))
    if uid != os.geteuid():
        raise SignerError("another user's process asks", hint="run it as the signer's user", code="wrong-user")


def _require(decision: Decision | None) -> None:
    if decision is not None and decision.verdict == "refused":
        raise _refusal(decision)


def _refusal(decision: Decision) -> SignerError:
    return SignerError(decision.why, hint=decision.next, code=decision.code)


def _refusal_of(connections: int) -> bytes:
    """What a client is sent for whom a socket has no place."""
    said = SignerError(
        f"{connections} connections to this socket ask something already",
        hint="end programs that wait for the signer, or wait a moment and ask again with the same key",
        code="too-many-connections",
    )
    body = msgspec.json.encode(protocol.ErrorAnswer(error=failure_of(said)))
    head = f"HTTP/1.1 503 Service Unavailable\r\nContent-Type: application/json\r\nContent-Length: {len(body)}\r\n"
    return head.encode() + b"Connection: close\r\n\r\n" + body


def _answered(answer: protocol.SignerAnswer, *, status: int = 200) -> web.Response:
    return web.Response(body=msgspec.json.encode(answer), status=status, content_type="application/json")


def _key(asked: protocol.OrderJob) -> str:
    """An idempotency key, as the log and people see it."""
    return plain(asked.idempotency_key, 128)


def _word(code: str) -> str:
    """A code that a stranger chose."""
    return "".join(one for one in code.lower() if one.isascii() and (one.isalnum() or one == "-"))[:64]
