"""The JSON interface of the page; `openapi.json` describes it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec
from aiohttp import web

import mesh
from bridges.web import recordings, rpc
from bridges.web.errors import InvalidRequest, OperatorsOnly, PageNotFound
from bridges.web.files import empty_summary
from bridges.web.views import liability_json, order_json
from mesh.agent.orders import default_lifetime
from mesh.network import call
from mesh.recording import NotARecording
from schemas import parse_address, parse_cid
from schemas.rpc import FinishLiability, RestartLiability, StartLiability

if TYPE_CHECKING:
    from bridges.web.server import PageServer

T = TypeVar("T")
LISTED: Final = 500
"""Things in one list."""
OPENAPI: Final = Path(__file__).with_name("openapi.json")
_DRIVEN: Final = {"start": StartLiability, "restart": RestartLiability}


class LocalOrder(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename="camel"):
    """What the local account orders."""

    model: str
    objective: str
    cost: str
    validator: str = ""
    validator_fee: str = "0"
    token: str = ""
    lifetime: int | None = None


class LocalWithdrawal(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The order that the local account withdraws."""

    order: str


class Form(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Values for a model's topics."""

    model: str
    values: list[dict[str, Any]]


class AgentAction(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The job that an operator starts, finishes or restarts."""

    liability: str
    success: bool = True


class Api:
    """The handlers of the interface, for a running server."""

    def __init__(self, server: PageServer) -> None:
        self._server = server
        self._parts = server.components
        self._market = server.market
        self._files = server.files
        self._views = server.views
        self._publisher = server.publisher
        self._facts: dict[str, Any] = {}
        self._facts_at = float("-inf")

    def routes(self) -> list[web.RouteDef]:
        """All routes of the interface."""
        get, post, file = web.get, web.post, "/api/v1/files/{cid}"
        return [
            get("/api/v1/openapi.json", self.openapi),
            get("/api/v1/market", self.market),
            get("/api/v1/agents", self.agents),
            get("/api/v1/models/{cid}", self.model),
            get("/api/v1/orders", self.orders),
            post("/api/v1/orders", self.post_order),
            get("/api/v1/orders/{hash}", self.order),
            post("/api/v1/local/orders", self.local_order),
            post("/api/v1/local/withdrawals", self.local_withdrawal),
            post("/api/v1/objectives", self.upload),
            post("/api/v1/objectives/form", self.form),
            get(file, self.file),
            get(f"{file}/summary", self.summary),
            get(f"{file}/preflight", self.preflight),
            get(f"{file}/messages", self.messages),
            get(f"{file}/values", self.values),
            get(f"{file}/images/{{number}}", self.image),
            get("/api/v1/liabilities", self.liabilities),
            get("/api/v1/liabilities/{address}", self.job),
            get("/api/v1/liabilities/{address}/verification", self.verification),
            get("/api/v1/accounts/{address}", self.account),
            post("/api/v1/agents/{address}/{action}", self.drive),
            get("/api/v1/lighthouse", self.lighthouse),
            get("/api/v1/stream", self.stream),
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
                "role": self._server.role_of(request),
                "connected": {"router": self._parts.network.connected, "chain": await self._server.has_chain()},
            }
        )

    async def _market_facts(self) -> dict[str, Any]:
        """What changes seldom; a few seconds old."""
        if time.monotonic() - self._facts_at < 10.0:
            return self._facts
        parts, chain, settings = self._parts, self._parts.chain, self._parts.settings
        block_time = await chain.node.heads.block_time(100)
        self._facts = {
            "lighthouse": {"name": parts.channel.lighthouse, "address": parts.lighthouse},
            "chainId": chain.chain_id,
            "generation": settings.generation,
            "contracts": "ours" if settings.contracts == "mesh" else "original",
            "blockTime": block_time or 0.0,
            "factory": chain.factory,
            "ens": chain.ens,
            "xrt": await self._market.contracts.labels.learn(chain.xrt),
            "token": await self._market.contracts.labels.learn(parts.token),
            "defaultLifetime": await default_lifetime(chain),
            "providers": sorted(await self._market.providers()),
            "limits": {"upload": self._files.upload_limit, "orders": 64},
            "robot": self._server.options.robot,
            "explorer": self._server.options.explorer,
            "version": mesh.__version__,
            "stream": self._server.stream.id,
        }
        self._facts_at = time.monotonic()
        return self._facts

    async def agents(self, request: web.Request) -> web.Response:
        return answer(await self._views.agents())

    async def model(self, request: web.Request) -> web.Response:
        return answer(await self._files.model(cid_in(request)))

    async def orders(self, request: web.Request) -> web.Response:
        query, head = request.query, self._market.head
        wanted = {name: query[name] for name in ("kind", "model", "signer") if query.get(name)}
        found = []
        for order in sorted(self._market.orders(), key=lambda order: -order.at):
            message = order.message
            facts = {"kind": message.kind, "model": message.model, "signer": order.verified.signer}
            if order.state(head) == "open" and all(facts[name] == value for name, value in wanted.items()):
                found.append(order)
        listed = [order_json(order) for order in found[: number_in(request, "limit", 100, most=LISTED)]]
        return answer({"orders": listed, "dropped": self._market.dropped})

    async def post_order(self, request: web.Request) -> web.Response:
        order = await self._publisher.post(await request.read())
        return answer(self._market.posted_json(order), status=202)

    async def order(self, request: web.Request) -> web.Response:
        order = self._market.order(request.match_info["hash"])
        if order is None:
            raise PageNotFound("this order was not seen here")
        return answer(self._market.posted_json(order))

    async def local_order(self, request: web.Request) -> web.Response:
        wanted = await body_of(request, LocalOrder)
        order = await self._publisher.order(
            objective=parse_text_cid(wanted.objective),
            model=wanted.model,
            cost=amount(wanted.cost),
            validator=wanted.validator,
            validator_fee=amount(wanted.validator_fee),
            token=wanted.token,
            lifetime=wanted.lifetime,
        )
        return answer(self._market.posted_json(order), status=202)

    async def local_withdrawal(self, request: web.Request) -> web.Response:
        order = await self._publisher.withdraw((await body_of(request, LocalWithdrawal)).order)
        return answer(self._market.posted_json(order))

    async def upload(self, request: web.Request) -> web.Response:
        model = request.query.get("model", "")
        if model:
            parse_cid(model)
        return answer(await self._files.upload(request.content.iter_chunked(1 << 16), model))

    async def form(self, request: web.Request) -> web.Response:
        form = await body_of(request, Form)
        return answer(await self._files.form(form.model, form.values))

    async def file(self, request: web.Request) -> web.StreamResponse:
        cid = cid_in(request)
        path = await self._files.fetch(cid)
        headers = {"Content-Disposition": f'attachment; filename="{cid}"', "Content-Type": "application/octet-stream"}
        return web.FileResponse(path, headers=headers | SANDBOX | FOREVER)

    async def summary(self, request: web.Request) -> web.Response:
        cid = cid_in(request)
        path = await self._files.fetch(cid)
        try:
            found = await self._files.in_thread(recordings.summary, path, cid)
        except NotARecording:
            found = empty_summary(cid, path.stat().st_size)
        return answer(found)

    async def preflight(self, request: web.Request) -> web.Response:
        path = await self._files.fetch(cid_in(request))
        return answer(await self._files.preflight(path, parse_text_cid(request.query.get("model", ""))))

    async def messages(self, request: web.Request) -> web.Response:
        cid = cid_in(request)
        after = number_in(request, "after", -1, least=-1)
        limit = number_in(request, "limit", 100, least=1, most=recordings.MOST_MESSAGES)
        topic = request.query.get("topic", "")
        return answer(await self._files.read(cid, recordings.messages, cid, topic=topic, after=after, limit=limit))

    async def values(self, request: web.Request) -> web.Response:
        if not (topic := request.query.get("topic", "")):
            raise InvalidRequest("give the topic")
        return answer(await self._files.read(cid_in(request), recordings.values, topic))

    async def image(self, request: web.Request) -> web.Response:
        number = request.match_info["number"]
        if not (number.isascii() and number.isdigit() and len(number) < 12):
            raise InvalidRequest("the number of a message is a number")
        found = await self._files.read(cid_in(request), recordings.image, int(number))
        if found is None:
            raise PageNotFound("there is no image in this message")
        data, kind = found
        return web.Response(body=data, content_type=kind, headers=SANDBOX | FOREVER)

    async def liabilities(self, request: web.Request) -> web.Response:
        query, limit = request.query, number_in(request, "limit", 50, most=LISTED)
        party = parse_address(query["party"]) if query.get("party") else ""
        found = []
        for job in reversed(self._market.contracts.jobs.values()):
            record = job.liability
            if party and party not in (record.promisee, record.promisor):
                continue
            if query.get("model") and query["model"] != record.model:
                continue
            if query.get("state") and (query["state"] == "finalized") != record.is_finalized:
                continue
            found.append(record)
            if len(found) > limit:
                break
        listed = [liability_json(record, self._market.contracts.labels) for record in found[:limit]]
        return answer({"liabilities": listed, "more": len(found) > limit})

    async def job(self, request: web.Request) -> web.Response:
        return answer(await self._views.job(address_in(request)))

    async def verification(self, request: web.Request) -> web.Response:
        return answer(await self._views.verification(address_in(request)))

    async def account(self, request: web.Request) -> web.Response:
        return answer(await self._views.account(address_in(request)))

    async def lighthouse(self, request: web.Request) -> web.Response:
        return answer(await self._views.lighthouse())

    async def drive(self, request: web.Request) -> web.Response:
        if self._server.role_of(request) != "operator":
            raise OperatorsOnly("only operators start, finish and restart jobs", hint="log in as an operator")
        wanted, action = await body_of(request, AgentAction), request.match_info["action"]
        liability = parse_address(wanted.liability)
        if action == "finish":
            command: Any = FinishLiability(liability, wanted.success)
        elif action in _DRIVEN:
            command = _DRIVEN[action](liability)
        else:
            raise PageNotFound(f"agents have no action {action[:40]}")
        done = await call(self._parts.network.session, address_in(request), action, command)
        return answer(msgspec.to_builtins(done))

    async def stream(self, request: web.Request) -> web.StreamResponse:
        return await self._server.stream.serve(request)

    async def rpc(self, request: web.Request) -> web.Response:
        return answer(await rpc.answer(self._parts.chain.node, await request.read()))


SANDBOX: Final = {"Content-Security-Policy": "default-src 'none'; sandbox"}
"""What strangers made is shown by nothing but our own page."""
FOREVER: Final = {"Cache-Control": "private, max-age=31536000, immutable"}
"""What a CID names never changes."""


def answer(content: Any, *, status: int = 200) -> web.Response:
    """A JSON response."""
    return web.Response(body=msgspec.json.encode(content), status=status, content_type="application/json")


async def body_of(request: web.Request, kind: type[T]) -> T:
    """The JSON body. Raises `InvalidRequest`."""
    try:
        return msgspec.json.decode(await request.read(), type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InvalidRequest(f"the body: {error}"[:200]) from None


def address_in(request: web.Request) -> str:
    """The address in the path. Raises `InvalidAddress`."""
    return parse_address(request.match_info["address"])


def cid_in(request: web.Request) -> str:
    """The CID in the path. Raises `InvalidCid`."""
    return parse_text_cid(request.match_info["cid"])


def parse_text_cid(text: str) -> str:
    """The text, if it is a CID. Raises `InvalidCid`."""
    parse_cid(text)
    return text


def amount(text: str) -> int:
    """An amount in the smallest unit. Raises `InvalidRequest`."""
    if not (text.isascii() and text.isdigit() and len(text) <= 78):
        raise InvalidRequest("an amount is a decimal number in the smallest unit")
    return int(text)


def number_in(request: web.Request, name: str, default: int, *, least: int = 0, most: int = 10**9) -> int:
    """A number in the query, at most `most`. Raises `InvalidRequest`."""
    text = request.query.get(name, "")
    if not text:
        return default
    try:
        number = int(text)
    except ValueError:
        raise InvalidRequest(f"{name} is a number") from None
    if number < least:
        raise InvalidRequest(f"{name} is at least {least}")
    return min(number, most)
