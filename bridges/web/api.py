"""The JSON interface of the page; `openapi.json` describes it."""

from __future__ import annotations

import time
from collections import Counter
from typing import TYPE_CHECKING, Any, Final, Protocol

import msgspec
from aiohttp import web

import mesh
from bridges.web import rpc
from bridges.web.answers import (
    address_in,
    amount,
    answer,
    body_of,
    number_in,
    parse_text_cid,
)
from bridges.web.errors import InvalidRequest, OperatorsOnly, PageNotFound
from bridges.web.file_api import FileApi
from bridges.web.orders import PER_SIGNER
from bridges.web.reference import OPENAPI
from bridges.web.validators import ValidatorApi
from bridges.web.views import liability_json
from mesh.agent.terms import default_lifetime
from mesh.errors import ChainError
from mesh.network import call
from mesh.watching.logs import LogReader
from schemas import parse_address
from schemas.agent_keys import RpcKey
from schemas.logs import LEVELS
from schemas.rpc import FinishLiability, RestartLiability, StartLiability

if TYPE_CHECKING:
    from bridges.web.components import WebComponents
    from bridges.web.files import Files
    from bridges.web.jobs import Views
    from bridges.web.market import Market
    from bridges.web.options import WebOptions
    from bridges.web.orders import OrderPublisher
    from bridges.web.stream import Stream

FACTS_AGE: Final = 10.0
"""Seconds for which facts of the market are used."""
LISTED: Final = 500
"""Things in one list."""
_DRIVEN: Final = {"start": StartLiability, "restart": RestartLiability}


class LocalOrder(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename="camel"):
    """What the local account orders."""

    model: str
    objective: str
    cost: str
    validator: str = ""
    validator_fee: str | None = None
    token: str = ""
    lifetime: int | None = None


class LocalWithdrawal(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The order that the local account withdraws."""

    order: str


class LocalRefund(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The job whose cost the local account takes back."""

    liability: str


class AgentAction(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The job that an operator starts, finishes or restarts."""

    liability: str
    success: bool = True


class RunningServer(Protocol):
    """What the handlers need of the server."""

    components: WebComponents
    options: WebOptions
    market: Market
    files: Files
    views: Views
    publisher: OrderPublisher
    stream: Stream

    def role_of(self, request: web.Request) -> str:
        """What the session of a request may do."""

    async def has_chain(self) -> bool:
        """Whether the node answers."""


class Api:
    """The handlers of the interface, for a running server."""

    def __init__(self, server: RunningServer) -> None:
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
        get, post = web.get, web.post
        return [
            get("/api/v1/openapi.json", self.openapi),
            get("/api/v1/market", self.market),
            get("/api/v1/agents", self.agents),
            get("/api/v1/orders", self.orders),
            post("/api/v1/orders", self.post_order),
            get("/api/v1/orders/{hash}", self.order),
            post("/api/v1/local/orders", self.local_order),
            post("/api/v1/local/withdrawals", self.local_withdrawal),
            post("/api/v1/local/refunds", self.local_refund),
            *FileApi(self._files).routes(),
            *ValidatorApi(self._parts).routes(),
            get("/api/v1/liabilities", self.liabilities),
            get("/api/v1/liabilities/{address}", self.job),
            get("/api/v1/liabilities/{address}/verification", self.verification),
            get("/api/v1/accounts/{address}", self.account),
            get("/api/v1/agents/{address}/logs", self.logs),
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
        """What changes seldom, a few seconds old; the last known while the node does not answer."""
        if time.monotonic() - self._facts_at > FACTS_AGE:
            try:
                self._facts = await self._read_facts()
            except ChainError:
                if not self._facts:
                    raise
            self._facts_at = time.monotonic()
        return self._facts

    async def _read_facts(self) -> dict[str, Any]:
        parts, chain, settings = self._parts, self._parts.chain, self._parts.settings
        block_time = await chain.node.heads.block_time(100)
        return {
            "lighthouse": {"name": parts.channel.lighthouse, "address": parts.lighthouse},
            "chainId": chain.chain_id,
            "generation": settings.generation,
            "contracts": "ours" if settings.contracts == "mesh" else "original",
            "blockTime": block_time or 0.0,
            "factory": chain.factory,
            "ens": chain.ens,
            "xrt": await self._market.contracts.labels.learn(chain.xrt),
            "token": await self._market.contracts.labels.learn(parts.token),
            "defaultLifetime": min(await default_lifetime(chain), settings.deadline_limit),
            "providers": sorted(await self._market.providers()),
            "limits": {"upload": self._files.upload_limit, "orders": PER_SIGNER, "lifetime": settings.deadline_limit},
            "robot": self._server.options.robot,
            "explorer": self._server.options.explorer,
            "version": mesh.__version__,
            "stream": self._server.stream.id,
        }

    async def agents(self, request: web.Request) -> web.Response:
        return answer(await self._views.agents())

    async def orders(self, request: web.Request) -> web.Response:
        query, head = request.query, self._market.head
        wanted = {name: query[name] for name in ("kind", "model", "signer") if query.get(name)}
        found = []
        for order in sorted(self._market.orders(), key=lambda order: -order.at):
            message = order.message
            facts = {"kind": message.kind, "model": message.model, "signer": order.verified.signer}
            if order.state(head) == "open" and all(facts[name] == value for name, value in wanted.items()):
                found.append(order)
        listed = [order.json() for order in found[: number_in(request, "limit", 100, most=LISTED)]]
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
            validator_fee=None if wanted.validator_fee is None else amount(wanted.validator_fee),
            token=wanted.token,
            lifetime=wanted.lifetime,
        )
        return answer(self._market.posted_json(order), status=202)

    async def local_withdrawal(self, request: web.Request) -> web.Response:
        order = await self._publisher.withdraw((await body_of(request, LocalWithdrawal)).order)
        return answer(self._market.posted_json(order))

    async def local_refund(self, request: web.Request) -> web.Response:
        address = parse_address((await body_of(request, LocalRefund)).liability)
        await self._publisher.refund(address)
        return answer({"liability": address})

    async def liabilities(self, request: web.Request) -> web.Response:
        query, limit = request.query, number_in(request, "limit", 50, most=LISTED)
        party = parse_address(query["party"]) if query.get("party") else ""
        jobs = [
            job
            for job in reversed(self._market.contracts.jobs.values())
            if (not party or party in (job.liability.promisee, job.liability.promisor))
            and query.get("model") in (None, "", job.liability.model)
        ]
        found = [
            job.liability
            for job in jobs
            if query.get("phase") in (None, "", job.phase)
            and (not query.get("state") or (query["state"] == "finalized") == job.liability.is_finalized)
        ]
        listed = [liability_json(record, self._market.contracts.labels) for record in found[:limit]]
        phases = Counter(job.phase for job in jobs)
        return answer({"liabilities": listed, "more": len(found) > limit, "phases": phases})

    async def job(self, request: web.Request) -> web.Response:
        return answer(await self._views.job(address_in(request)))

    async def verification(self, request: web.Request) -> web.Response:
        return answer(await self._views.verification(address_in(request)))

    async def account(self, request: web.Request) -> web.Response:
        return answer(await self._views.account(address_in(request)))

    async def lighthouse(self, request: web.Request) -> web.Response:
        return answer(await self._views.lighthouse())

    async def logs(self, request: web.Request) -> web.Response:
        options = self._server.options
        if options.has_login and self._server.role_of(request) != "operator":
            raise OperatorsOnly("only operators read logs", hint="log in as an operator")
        level = request.query.get("level", "info")
        if level not in LEVELS:
            raise InvalidRequest(f"a level is one of {', '.join(LEVELS)}")
        lines = number_in(request, "lines", 100, least=1, most=LISTED)
        key = str(RpcKey(address_in(request), "logs"))
        update = await LogReader(self._parts.network.session, key, lines=lines, level=level).poll(timeout=2.0)
        events = [msgspec.to_builtins(event) for event in update.events[-lines:]]
        return answer({"events": events, "answered": update.answered})

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
