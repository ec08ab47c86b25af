"""The JSON interface of the page, which `openapi.json` describes, and the JSON-RPC that is passed on to the node."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
from aiohttp import web
from msgspec.structs import replace

import mesh
from bridges.web._access import (
    FOREVER,
    SANDBOX,
    SENDER,
    WebError,
    address_in,
    amount,
    answer,
    body_of,
    cid_in,
    number_in,
    parse_text_cid,
)
from bridges.web._files import (
    FILE_LIMITS,
    Files,
    columns_of,
    empty_summary,
    image_of,
    messages_of,
    picture_of,
    summary_of,
)
from bridges.web._live import Live
from bridges.web._market import MARKET_LIMITS, Market, OrderPublisher, judged_terms, liability_json
from bridges.web._stream import Stream
from bridges.web._views import PastContracts, Questions, Views
from mesh.agent.orders import lifetime_of
from mesh.base.background import Background
from mesh.base.lifecycle import Lifecycle
from mesh.chain import RequestRefused, Reverted
from mesh.errors import AiraError, ChainError, public_text
from mesh.network import call
from mesh.recording import NotARecording
from mesh.role.local_stop import control_here, stop_folder
from mesh.signer.client import SignerClient
from mesh.watching.presence import LogReader
from schemas import parse_address, parse_cid
from schemas.decoding import InvalidData, decode_json
from schemas.keys import RpcKey
from schemas.records import ControlRobot
from schemas.rpc import AcceptDemand, FinishLiability, LiabilityRequest, Nothing, OrderPair
from schemas.signing import StopRequest
from schemas.status import LEVELS

if TYPE_CHECKING:
    from contextlib import AsyncExitStack

    from bridges.web._access import Logins, WebOptions
    from bridges.web.components import WebComponents
    from mesh.chain import Node
    from schemas.verdicts import ValidatorAnnouncement


log = logging.getLogger(__name__)

METHODS: Final = frozenset(
    [
        "eth_blockNumber",
        "eth_call",
        "eth_chainId",
        "eth_estimateGas",
        "eth_feeHistory",
        "eth_gasPrice",
        "eth_getBalance",
        "eth_getBlockByNumber",
        "eth_getCode",
        "eth_getTransactionByHash",
        "eth_getTransactionCount",
        "eth_getTransactionReceipt",
        "eth_maxPriorityFeePerGas",
        "net_version",
    ]
)
"""The methods that are passed on. None of them changes anything, and none reads a range of blocks."""


class RpcRequest(msgspec.Struct, frozen=True):
    """A request of JSON-RPC 2.0."""

    method: str
    params: list[Any] = msgspec.field(default_factory=list)
    id: int | str | None = None
    jsonrpc: str = "2.0"


OPENAPI: Final = Path(__file__).with_name("openapi.json")


class AgentsPace(NamedTuple):
    """How often the agents are looked for, in seconds."""

    interval: float = 3.0
    """Between two lists of agents on the stream, …"""
    unseen: float = 60.0
    """… and between two looks at who is here while nobody asks, so that it is known who is away."""


AGENTS_PACE: Final = AgentsPace()
LISTED: Final = 500
"""Things in one list."""


# The bodies of requests, which openapi.json describes.


class Form(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    model: str
    values: list[dict[str, Any]]


class LocalOrder(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename="camel"):
    model: str
    objective: str
    cost: str
    validator: str = ""
    validator_fee: str | None = None
    token: str = ""
    lifetime: int | None = None
    robot: str = ""
    """The only robot (address) that it is for."""


class QuotesWanted(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    model: str
    objective: str


class LocalWithdrawal(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    order: str


class LocalRefund(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    liability: str


class LocalStop(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    liability: str
    why: str = ""


class AgentAction(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    liability: str
    success: bool = True


class RobotStop(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    why: str = ""


class ConsentAnswer(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    allow: bool


class Api(Lifecycle):
    """The handlers of the interface, and what they show: the market, files, the stream."""

    title = "interface of the page"

    def __init__(self, components: WebComponents, options: WebOptions, logins: Logins) -> None:
        self._parts = components
        self._options = options
        self._logins = logins
        self.stream = Stream()
        self.files = Files(components)
        self._market = Market(components, self.stream, from_block=options.from_block)
        self._views = Views(components, self._market, self.files)
        self._publisher = OrderPublisher(components, self._market)
        self._live = Live(components, self._market, self.stream)
        self._history = PastContracts(components, self._market)
        self._questions = Questions(components, self._market.labels)
        self._facts: dict[str, Any] = {}
        self._facts_at = float("-inf")
        self.chain_answers = True
        """Whether the node answered when it was last asked."""
        self._chain_asked = float("-inf")

    async def _open(self, stack: AsyncExitStack) -> None:
        await stack.enter_async_context(self._live)
        await stack.enter_async_context(self._market)
        await stack.enter_async_context(self._publisher)
        tasks = await stack.enter_async_context(Background())
        tasks.start(self._show_agents(), "page: agents")
        tasks.start(self._show_connection(), "page: connection")
        tasks.start(self._parts.drops.run(), "page: drops")

    def routes(self) -> list[web.RouteDef]:
        get, post, file = web.get, web.post, "/api/v1/files/{cid}"
        return [
            get("/api/v1/openapi.json", self.openapi),
            get("/api/v1/market", self.market),
            get("/api/v1/market/history", self.history),
            get("/api/v1/agents", self.agents),
            post("/api/v1/quotes", self.quotes),
            post("/api/v1/pairs", self.post_pair),
            post("/api/v1/pairs/offers", self.robot_offer),
            get("/api/v1/orders", self.orders),
            post("/api/v1/orders", self.post_order),
            post("/api/v1/permits", self.post_permit),
            get("/api/v1/orders/{hash}", self.order),
            post("/api/v1/local/orders", self.local_order),
            post("/api/v1/local/withdrawals", self.local_withdrawal),
            post("/api/v1/local/refunds", self.local_refund),
            post("/api/v1/local/stops", self.local_stop),
            post("/api/v1/stops", self.stop),
            get("/api/v1/models/{cid}", self.model),
            post("/api/v1/objectives", self.upload),
            post("/api/v1/objectives/form", self.form),
            get(file, self.file),
            get(f"{file}/recording.{{format}}", self.file),
            get(f"{file}/summary", self.summary),
            get(f"{file}/preflight", self.preflight),
            get(f"{file}/messages", self.messages),
            get(f"{file}/values", self.values),
            get(f"{file}/images/{{number}}", self.image),
            get(f"{file}/picture", self.picture),
            get("/api/v1/validators/{validator}", self.validator),
            get("/api/v1/liabilities", self.liabilities),
            get("/api/v1/liabilities/{address}", self.job),
            get("/api/v1/liabilities/{address}/verification", self.verification),
            get("/api/v1/liabilities/{address}/live", self.live),
            get("/api/v1/accounts/{address}", self.account),
            get("/api/v1/accounts/{address}/permit-fee", self.permit_fee),
            get("/api/v1/accounts/{address}/statement", self.statement),
            get("/api/v1/agents/{address}/readings", self.readings),
            get("/api/v1/agents/{address}/logs", self.logs),
            get("/api/v1/agents/{address}/settings", self.control),
            post("/api/v1/agents/{address}/settings", self.change_settings),
            post("/api/v1/agents/{address}/stop", self.stop_robot),
            post("/api/v1/agents/{address}/release", self.release_robot),
            post("/api/v1/agents/{address}/{action}", self.drive),
            get("/api/v1/consents", self.consents),
            post("/api/v1/consents/{id}", self.answer_consent),
            get("/api/v1/lighthouse", self.lighthouse),
            get("/api/v1/stream", self.stream.serve),
            post("/rpc", self.rpc),
        ]

    async def openapi(self, request: web.Request) -> web.StreamResponse:
        return web.FileResponse(OPENAPI)

    async def market(self, request: web.Request) -> web.Response:
        facts = await self._market_facts()
        agent = self._parts.agent
        return answer(
            facts
            | {
                "block": self._market.head,
                "account": None if agent is None else agent.address,
                "role": self._logins.role_of(request),
                "connected": await self._connected(),
            }
        )

    async def _connected(self) -> dict[str, bool]:
        return {"router": self._parts.network.connected, "chain": await self.has_chain()}

    async def _market_facts(self) -> dict[str, Any]:
        """What changes seldom, a few seconds old; the last known while the node does not answer."""
        if time.monotonic() - self._facts_at > 10.0:  # seconds for which facts of the market are used
            try:
                self._facts = await self._read_facts()
            except ChainError:
                if not self._facts:
                    raise
            self._facts_at = time.monotonic()
        return self._facts

    async def _read_facts(self) -> dict[str, Any]:
        parts, chain, settings = self._parts, self._parts.chain, self._parts.settings
        block_time = await chain.node.contract_blocks.seconds(100)
        return {
            "lighthouse": {"name": parts.channel.lighthouse, "address": parts.lighthouse},
            "chainId": chain.chain_id,
            "generation": settings.generation,
            "contracts": "ours" if settings.contracts == "mesh" else "original",
            "blockTime": block_time or 0.0,
            "factory": chain.factory,
            "ens": chain.ens,
            "xrt": await self._market.labels.learn(chain.xrt),
            "token": await self._market.labels.learn(parts.token),
            "defaultLifetime": min(await lifetime_of(chain), settings.deadline_limit),
            "providers": sorted(await self._market.providers()),
            "limits": {
                "upload": self.files.upload_limit,
                "orders": MARKET_LIMITS.per_signer,
                "lifetime": settings.deadline_limit,
            },
            "robot": self._options.robot,
            "asksForConsent": bool(self._options.signer),
            "explorer": self._options.explorer,
            "version": mesh.__version__,
            "stream": self.stream.id,
        }

    async def has_chain(self) -> bool:
        """Whether the node answers; asked once in three seconds."""
        if time.monotonic() - self._chain_asked > AGENTS_PACE.interval:
            self._chain_asked = time.monotonic()
            try:
                async with asyncio.timeout(2.0):
                    await self._parts.chain.block_number()
                self.chain_answers = True
            except (AiraError, TimeoutError):
                self.chain_answers = False
        return self.chain_answers

    async def agents(self, request: web.Request) -> web.Response:
        return answer(await self._views.agents())

    async def quotes(self, request: web.Request) -> web.Response:
        wanted = await body_of(request, QuotesWanted)
        model, objective = parse_text_cid(wanted.model), parse_text_cid(wanted.objective)
        return answer({"quotes": await self._questions.quotes(model, objective, sender=request[SENDER])})

    async def orders(self, request: web.Request) -> web.Response:
        query, head = request.query, self._market.head
        wanted = {name: query[name] for name in ("kind", "model", "signer") if query.get(name)}
        found = []
        for order in sorted(self._market.orders(), key=lambda order: -order.at):
            message = order.message
            facts = {"kind": message.kind, "model": message.model, "signer": order.verified.signer}
            if (
                not order.robot
                and order.state(head) == "open"
                and all(facts[name] == value for name, value in wanted.items())
            ):
                found.append(order)
        listed = [order.json() for order in found[: number_in(request, "limit", 100, most=LISTED)]]
        return answer({"orders": listed, "dropped": self._market.dropped})

    async def post_order(self, request: web.Request) -> web.Response:
        order = await self._publisher.post(await request.read())
        return answer(self._market.posted_json(order), status=202)

    async def post_permit(self, request: web.Request) -> web.Response:
        await self._publisher.post_permit(await request.read())
        return answer({}, status=202)

    async def robot_offer(self, request: web.Request) -> web.Response:
        wanted = AcceptDemand.decode(await request.read())
        accepted = await self._questions.offer(wanted, sender=request[SENDER])
        return web.Response(body=accepted.encode(), content_type="application/json")

    async def post_pair(self, request: web.Request) -> web.Response:
        order = await self._publisher.post_pair(OrderPair.decode(await request.read()))
        return answer(self._market.posted_json(order), status=202)

    async def order(self, request: web.Request) -> web.Response:
        order = self._market.order(request.match_info["hash"])
        if order is None:
            raise WebError("this order was not seen here", code="page-not-found")
        return answer(self._market.posted_json(order))

    async def local_order(self, request: web.Request) -> web.Response:
        wanted = await body_of(request, LocalOrder)
        order = await self._publisher.order(
            objective=parse_text_cid(wanted.objective),
            model=wanted.model,
            cost=amount(wanted.cost),
            validator=wanted.validator,
            validator_fee=None if wanted.validator_fee is None else amount(wanted.validator_fee),
            token=wanted.token,
            lifetime=wanted.lifetime,
            robot=parse_address(wanted.robot) if wanted.robot else "",
        )
        return answer(self._market.posted_json(order), status=202)

    async def local_withdrawal(self, request: web.Request) -> web.Response:
        order = await self._publisher.withdraw((await body_of(request, LocalWithdrawal)).order)
        return answer(self._market.posted_json(order))

    async def local_refund(self, request: web.Request) -> web.Response:
        address = parse_address((await body_of(request, LocalRefund)).liability)
        await self._publisher.refund(address)
        return answer({"liability": address})

    async def local_stop(self, request: web.Request) -> web.Response:
        wanted = await body_of(request, LocalStop)
        return answer(await self._publisher.stop(parse_address(wanted.liability), wanted.why))

    async def stop(self, request: web.Request) -> web.Response:
        return answer(await self._publisher.pass_stop(StopRequest.decode(await request.read())))

    async def consents(self, request: web.Request) -> web.Response:
        async with self._signer(request) as signer:
            return answer({"consents": await signer.consents()})

    async def answer_consent(self, request: web.Request) -> web.Response:
        allow = (await body_of(request, ConsentAnswer)).allow
        async with self._signer(request) as signer:
            answered = await (signer.approve if allow else signer.deny)(request.match_info["id"])
        return answer({"job": answered.job_id, "state": answered.state})

    def _signer(self, request: web.Request) -> SignerClient:
        """The signer of the page's owner, for people who logged in as operators. Raises `WebError`."""
        if not self._options.signer:
            raise WebError("this server knows no signer", hint="start it with --signer", code="page-not-found")
        self._logins.require_operator_login(request, "allow orders of programs")
        return SignerClient(Path(self._options.signer))

    async def model(self, request: web.Request) -> web.Response:
        return answer(await self.files.model(cid_in(request)))

    async def upload(self, request: web.Request) -> web.Response:
        model = request.query.get("model", "")
        if model:
            parse_cid(model)
        chunks = request.content.iter_chunked(1 << 16)
        return answer(await self.files.upload(chunks, model, sender=request[SENDER], stated=request.content_length))

    async def form(self, request: web.Request) -> web.Response:
        form = await body_of(request, Form)
        return answer(await self.files.form(form.model, form.values))

    async def file(self, request: web.Request) -> web.StreamResponse:
        cid = cid_in(request)
        path = await self.files.fetch(cid)
        headers = {"Content-Disposition": f'attachment; filename="{cid}"', "Content-Type": "application/octet-stream"}
        return web.FileResponse(path, headers=headers | SANDBOX | FOREVER)

    async def summary(self, request: web.Request) -> web.Response:
        cid = cid_in(request)
        path = await self.files.fetch(cid)
        try:
            found = await self.files.in_thread(summary_of, path, cid)
        except NotARecording:
            found = empty_summary(cid, path.stat().st_size)
        return answer(found)

    async def preflight(self, request: web.Request) -> web.Response:
        path = await self.files.fetch(cid_in(request))
        return answer(await self.files.preflight(path, parse_text_cid(request.query.get("model", ""))))

    async def messages(self, request: web.Request) -> web.Response:
        cid = cid_in(request)
        after = number_in(request, "after", -1, least=-1)
        limit = number_in(request, "limit", 100, least=1, most=FILE_LIMITS.messages)
        topic = request.query.get("topic", "")
        return answer(await self.files.read(cid, messages_of, cid, topic=topic, after=after, limit=limit))

    async def values(self, request: web.Request) -> web.Response:
        if not (topic := request.query.get("topic", "")):
            raise WebError("give the topic")
        return answer(await self.files.read(cid_in(request), columns_of, topic))

    async def image(self, request: web.Request) -> web.Response:
        number = request.match_info["number"]
        if not (number.isascii() and number.isdigit() and len(number) < 12):
            raise WebError("the number of a message is a number")
        found = await self.files.read(cid_in(request), image_of, int(number))
        return _image(found, missing="there is no image in this message")

    async def picture(self, request: web.Request) -> web.Response:
        return _image(await self.files.read(cid_in(request), picture_of), missing="this file is no picture")

    async def validator(self, request: web.Request) -> web.Response:
        fee = request.query.get("fee", "")
        judged = await judged_terms(self._parts, request.match_info["validator"], amount(fee) if fee else None)
        signed = [_signed(one) for one in judged.announced.announcements]
        return answer(judged.json() | {"refund": judged.refund, "announcements": signed})

    async def liabilities(self, request: web.Request) -> web.Response:
        query, limit = request.query, number_in(request, "limit", 50, most=LISTED)
        party = parse_address(query["party"]) if query.get("party") else ""
        jobs = [
            job
            for job in reversed(self._market.jobs.values())
            if (not party or party in (job.liability.promisee, job.liability.promisor))
            and query.get("model") in (None, "", job.liability.model)
        ]
        found = [
            job.liability
            for job in jobs
            if query.get("phase") in (None, "", job.phase)
            and (not query.get("state") or (query["state"] == "finalized") == job.liability.is_finalized)
        ]
        listed = [liability_json(record, self._market.labels) for record in found[:limit]]
        phases = Counter(job.phase for job in jobs)
        return answer({"liabilities": listed, "more": len(found) > limit, "phases": phases})

    async def job(self, request: web.Request) -> web.Response:
        return answer(await self._views.job(address_in(request)))

    async def verification(self, request: web.Request) -> web.Response:
        return answer(await self._views.verification(address_in(request)))

    async def live(self, request: web.Request) -> web.Response:
        return answer({"samples": await self._live.samples(address_in(request))})

    async def readings(self, request: web.Request) -> web.Response:
        return answer({"readings": await self._live.readings(address_in(request))})

    async def account(self, request: web.Request) -> web.Response:
        return answer(await self._views.account(address_in(request)))

    async def permit_fee(self, request: web.Request) -> web.Response:
        return answer(await self._views.permit_fee(address_in(request), amount(request.query.get("cost", ""))))

    async def statement(self, request: web.Request) -> web.Response:
        account, sender = address_in(request), request[SENDER]
        if request.query.get("format", "json") == "json":
            return answer(await self._history.statement(account, sender=sender))
        if request.query["format"] != "csv":
            raise WebError("a statement is json or csv")
        text = await self._history.statement_csv(account, sender=sender)
        headers = {"Content-Disposition": f'attachment; filename="statement-{account}.csv"'}
        return web.Response(text=text, content_type="text/csv", headers=headers | SANDBOX)

    async def history(self, request: web.Request) -> web.Response:
        model = request.query.get("model", "")
        return answer(await self._history.jobs(parse_text_cid(model) if model else ""))

    async def lighthouse(self, request: web.Request) -> web.Response:
        return answer(await self._views.lighthouse())

    async def logs(self, request: web.Request) -> web.Response:
        if self._options.has_login:
            self._logins.require_operator(request, "read logs")
        level = request.query.get("level", "info")
        if level not in LEVELS:
            raise WebError(f"a level is one of {', '.join(LEVELS)}")
        lines = number_in(request, "lines", 100, least=1, most=LISTED)
        key = str(RpcKey(address_in(request), "logs"))
        update = await LogReader(self._parts.network.session, key, lines=lines, level=level).poll(timeout=2.0)
        events = [msgspec.to_builtins(event) for event in update.events[-lines:]]
        return answer({"events": events, "answered": update.answered})

    async def drive(self, request: web.Request) -> web.Response:
        self._logins.require_operator(request, "start, finish and restart jobs")
        wanted, action = await body_of(request, AgentAction), request.match_info["action"]
        liability = parse_address(wanted.liability)
        if action == "finish":
            command: Any = FinishLiability(liability, wanted.success)
        elif action in ("start", "restart"):
            command = LiabilityRequest(liability)
        else:
            raise WebError(f"agents have no action {action[:40]}", code="page-not-found")
        done = await call(self._parts.network.session, address_in(request), action, command)
        return answer(msgspec.to_builtins(done))

    async def control(self, request: web.Request, asked: ControlRobot | None = None) -> web.Response:
        """Let a robot do what its owner wants: by the data folder if it is the server's own, else by its service."""
        self._logins.require_operator(request, "control robots")
        agent, asked, parts = address_in(request), asked or ControlRobot(), self._parts
        done = await asyncio.to_thread(control_here, stop_folder(parts.settings), agent, asked)
        is_here = done is not None
        done = done or await call(parts.network.session, agent, "control", asked)
        return answer(msgspec.to_builtins(done) | {"here": is_here})

    async def change_settings(self, request: web.Request) -> web.Response:
        return await self.control(request, await body_of(request, ControlRobot))

    async def stop_robot(self, request: web.Request) -> web.Response:
        return await self.control(request, ControlRobot(stop=(await body_of(request, RobotStop)).why))

    async def release_robot(self, request: web.Request) -> web.Response:
        await body_of(request, Nothing)
        return await self.control(request, ControlRobot(release=True))

    async def rpc(self, request: web.Request) -> web.Response:
        return answer(await _answer_rpc(self._parts.chain.node, await request.read()))

    async def _show_connection(self) -> None:
        """Publish when the router or the node is lost, and when it is back."""
        last = None
        while True:
            if (connected := await self._connected()) != last:
                last = connected
                self.stream.publish("connection", "connection", connected)
            await asyncio.sleep(0.5)  # seconds between two looks

    async def _show_agents(self) -> None:
        """Publish the agents while somebody looks at them."""
        last, asked = b"", float("-inf")
        while True:
            await asyncio.sleep(AGENTS_PACE.interval)
            if not self.stream.has_subscribers("agents") and time.monotonic() - asked < AGENTS_PACE.unseen:
                continue
            asked = time.monotonic()
            try:
                agents = await self._views.agents()
            except AiraError as error:
                log.debug("the agents can't be listed: %s", error)
                continue
            if (text := msgspec.json.encode(agents)) != last:
                last = text
                self.stream.publish("agents", "agents", agents)


async def _answer_rpc(node: Node, body: bytes) -> dict[str, Any]:
    """The response to a request. Raises `WebError` for what is none."""
    try:
        request = decode_json(body, RpcRequest)
    except InvalidData as error:
        raise WebError(f"not a request of JSON-RPC: {error}"[:200]) from None
    response: dict[str, Any] = {"jsonrpc": "2.0", "id": request.id}
    if request.method not in METHODS or len(request.params) > 8:
        return response | {"error": {"code": -32601, "message": f"{request.method[:64]} is not passed on"}}
    try:
        return response | {"result": await node.request(request.method, *request.params)}
    except Reverted as error:
        code, data = 3, {"data": "0x" + error.data.hex()}
        return response | {"error": {"code": code, "message": public_text(error)} | data}
    except RequestRefused as error:
        return response | {"error": {"code": error.rpc_code, "message": public_text(error.detail)}}
    except ChainError as error:
        return response | {"error": {"code": -32000, "message": public_text(error)}}


def _image(found: tuple[bytes, str] | None, *, missing: str) -> web.Response:
    """An image with its media type. Raises `WebError` if there is none."""
    if found is None:
        raise WebError(missing, code="page-not-found")
    data, kind = found
    return web.Response(body=data, content_type=kind, headers=SANDBOX | FOREVER)


def _signed(announcement: ValidatorAnnouncement) -> dict[str, Any]:
    """An announcement as the text that its juror has signed, so that a browser can check it."""
    text = replace(announcement, signature="").encode().decode()
    return {"juror": announcement.juror, "text": text, "signature": announcement.signature}
