"""The nodes, topics and services of the legacy stack in front of an agent, as its documentation and programs know them.

Whoever is on the ROS graph is a local operator, as ROS 1 has no access control. What signs or spends goes through the
agent's own services: it is refused unless the agent's `open_services` allows it, and their limits and deadlines hold.

Files are those of the mesh's stores. A service reads and writes only below the folders that it is given: by default the
one for temporary files, where the legacy programs put theirs.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import shutil
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, get_args

import msgspec
import zenoh

from bridges.ros1._definitions import md5_of, message_types, service_types
from bridges.ros1._topics import TOPIC_PACE, advertise, type_in
from bridges.ros1._wire import resolve
from bridges.ros1.messages import plain
from mesh.amounts import ETH as ETHER
from mesh.amounts import XRT
from mesh.base.background import Background, call_in_loop
from mesh.base.flood import BoundedDict
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import log_event
from mesh.errors import AiraError, InputError
from mesh.network import Pump, call
from mesh.network.services import declared
from mesh.recording import Recorder, RecordingAbout, open_objective, play
from schemas import (
    ZERO_ADDRESS,
    Demand,
    Liability,
    Offer,
    OrderFeedback,
    PlaybackPosition,
    Result,
    TransactionFeedback,
    decode,
    parse_address,
)
from schemas.keys import EthEvent, EthEventKey, EventKey, event_selector, market_selector, parse_agent_key
from schemas.rpc import SERVICES, ApprovalEvent, Nothing, TransferEvent

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from contextlib import AsyncExitStack

    from bridges.ros1._topics import RosBridgeOptions, RosBridgeParts, RosJobs
    from bridges.ros1.node import Handler, Ros1Node, Ros1Publisher, Ros1Subscription
    from mesh.recording import Objective
    from schemas import Record

log = logging.getLogger(__name__)

EXECUTOR: Final = "/liability/executor"
LISTENER: Final = "/liability/listener"
CHANNEL: Final = "/liability/infochan/ipfs_channel"
SIGNER: Final = "/liability/infochan/eth/signer"
CHANNEL_OF_OCTOBER: Final = "/liability/infochan/channel"
SIGNER_OF_OCTOBER: Final = "/liability/infochan/signer"
TOKEN: Final = "/eth/erc20_token"
ETH: Final = "/eth/eth_node"
PERSISTENCE: Final = "/liability/persistence"
NODES: Final = (EXECUTOR, LISTENER, CHANNEL, SIGNER, CHANNEL_OF_OCTOBER, SIGNER_OF_OCTOBER, TOKEN, ETH, PERSISTENCE)
"""The nodes of the legacy stack; two were called otherwise in October 2018."""

LIABILITY: Final = "robonomics_liability/Liability"
KINDS: Final[Mapping[str, type[Demand | Offer | Result]]] = {"demand": Demand, "offer": Offer, "result": Result}
FEEDBACK: Final[Mapping[type[OrderFeedback | TransactionFeedback], tuple[str, str]]] = {
    OrderFeedback: ("/liability/infochan/incoming/feedback/added_order", "robonomics_msgs/AddedOrderFeedback"),
    TransactionFeedback: (
        "/liability/infochan/incoming/feedback/added_pending_transaction",
        "robonomics_msgs/AddedPendingTransactionFeedback",
    ),
}
"""What providers of generation 5 say about orders: topic and type."""
AMOUNTS: Final = ("cost", "deadline", "validatorFee", "lighthouseFee")


class LegacyLimits(NamedTuple):
    """What the topics and services of the legacy nodes may take."""

    waiting: int = 256
    """Messages to be signed or sent that wait."""
    jobs: int = 1024
    """Jobs whose result is still to be published."""
    kept_seconds: float = 5.0
    """Seconds for which the market's messages are kept for nodes that subscribe just then …"""
    kept: int = 64
    """… and messages of one kind that are kept so."""
    answer: float = 5.0
    """Seconds for the agent's answer which jobs it has."""
    fetch: float = 60.0
    """Seconds for a file, without a new block of it."""
    players: int = 16
    """Players of bags at the same time."""


LEGACY_LIMITS: Final = LegacyLimits()


class Nonce(bytes):
    """The nonce of an order: 32 bytes up to generation 4, and decimal digits after that."""

    def __str__(self) -> str:
        return str(int.from_bytes(self, "big"))


class LegacyGraph(Lifecycle):
    """The legacy stack's names for the agent, on `nodes`: `async with LegacyGraph(...)`."""

    title = "legacy names on ROS 1"

    def __init__(
        self, parts: RosBridgeParts, options: RosBridgeOptions, nodes: Mapping[str, Ros1Node], jobs: RosJobs
    ) -> None:
        self._session = parts.network.session
        self._channel = parts.channel
        self._nodes = nodes
        self._jobs = jobs
        self._agent = parse_address(parts.agent)
        self._exchange = parts.exchange
        self._size_limit = options.size_limit
        self._generation = options.generation
        self._requests: asyncio.Queue[tuple[str, dict[str, Any]]] = asyncio.Queue(LEGACY_LIMITS.waiting)
        self._complete: BoundedDict[str, bool] = BoundedDict(LEGACY_LIMITS.jobs)
        self._topics: dict[str, Ros1Publisher] = {}
        self._phases: BoundedDict[str, str] = BoundedDict(LEGACY_LIMITS.jobs)

    async def _open(self, stack: AsyncExitStack) -> None:
        loop = asyncio.get_running_loop()
        self._tasks = await stack.enter_async_context(Background())
        await self._advertise_all()
        await self._serve_all()
        self._tasks.start(self._send_requests(), "messages of ROS nodes")
        for kind in KINDS.values():
            self._tasks.start(self._show_market(kind), f"{kind.__name__}s to ROS")
        for feedback in FEEDBACK:
            self._tasks.start(self._show_feedback(feedback), f"{feedback.__name__} to ROS")

        def declare(selector: str, handler: Callable[[str, bytes], None]) -> None:
            def received(sample: zenoh.Sample) -> None:
                call_in_loop(loop, handler, str(sample.key_expr), sample.payload.to_bytes())

            stack.enter_context(declared(self._session, self._session.declare_subscriber(selector, received)))

        declare(event_selector(self._agent), self._handle_event)
        for event in get_args(EthEvent):
            declare(str(EthEventKey(self._agent, event)), self._handle_token_event)
        # Jobs that are ready already, as after a restart of this bridge.
        self._tasks.start(self._recall_jobs(), "jobs at the start")

    async def _advertise_all(self) -> None:
        for node, topic, type in (
            (LISTENER, "/liability/incoming", LIABILITY),
            (LISTENER, "/liability/finalized", "std_msgs/String"),
            (EXECUTOR, "/liability/ready", LIABILITY),
            (EXECUTOR, "/liability/complete", LIABILITY),
            (EXECUTOR, "/liability/result", "robonomics_msgs/Result"),
            (TOKEN, "/eth/event/transfer", "ethereum_common/TransferEvent"),
            (TOKEN, "/eth/event/approval", "ethereum_common/ApprovalEvent"),
            *((CHANNEL, topic, type) for topic, type in FEEDBACK.values()),
            *((CHANNEL, f"/liability/infochan/incoming/{kind}", _type_of(kind)) for kind in KINDS),
            *((SIGNER, f"/liability/infochan/eth/sending/{kind}", _type_of(kind)) for kind in KINDS),
        ):
            versions = message_types()[type]
            default = versions[md5_of(type, self._generation)]
            self._topics[topic] = await self._nodes[node].advertise(topic, default, versions.values())
        for kind in KINDS:
            for node, topic, service in (
                (SIGNER, "eth/signing", "sign"),
                (CHANNEL, "eth/sending", "send"),
                (SIGNER_OF_OCTOBER, "signing", "sign"),
                (CHANNEL_OF_OCTOBER, "sending", "send"),
            ):
                received = partial(self._request, f"{service}/{kind}", _type_of(kind))
                await self._nodes[node].subscribe(f"/liability/infochan/{topic}/{kind}", _type_of(kind), received)

    async def _serve_all(self) -> None:
        started, balance = "robonomics_liability/StartLiability", "ethereum_common/AccountBalance"
        own, allowed = "ethereum_common/Balance", "ethereum_common/AccountToAddressAllowance"
        own_allowed = "ethereum_common/Allowance"
        handlers: list[tuple[str, str, str, Handler]] = [
            (EXECUTOR, "/liability/start", started, partial(self._drive, "start")),
            (EXECUTOR, "/liability/restart", started, partial(self._drive, "restart")),
            (EXECUTOR, "/liability/resume", started, partial(self._drive, "resume")),
            (EXECUTOR, "/liability/finish", "robonomics_liability/FinishLiability", self._finish),
            (LISTENER, "/liability/read", "robonomics_liability/ReadLiability", self._read),
            (PERSISTENCE, f"{PERSISTENCE}/exists", "robonomics_liability/PersistenceContainsLiability", self._exists),
            (
                PERSISTENCE,
                f"{PERSISTENCE}/get_liability_timestamp",
                "robonomics_liability/PersistenceLiabilityTimestamp",
                self._played_until,
            ),
            (ETH, "/eth/accounts", "ethereum_common/Accounts", self._eth("accounts")),
            (ETH, "/eth/current_block", "ethereum_common/BlockNumber", self._eth("current_block")),
            (ETH, "/eth/account_eth_balance", balance, self._eth("account_eth_balance", ETHER.decimals)),
            (ETH, "/eth/eth_balance", own, self._eth("eth_balance", ETHER.decimals)),
            (TOKEN, "/eth/transfer", "ethereum_common/Transfer", self._eth("transfer")),
            (TOKEN, "/eth/transfer_from", "ethereum_common/TransferFrom", self._eth("transfer_from")),
            (TOKEN, "/eth/approve", "ethereum_common/Approve", self._eth("approve")),
            (TOKEN, "/eth/account_xrt_balance", balance, self._eth("account_xrt_balance", XRT.decimals)),
            (TOKEN, "/eth/xrt_balance", own, self._eth("xrt_balance", XRT.decimals)),
            (TOKEN, "/eth/account_xrt_allowance", allowed, self._eth("account_xrt_allowance")),
            (TOKEN, "/eth/xrt_allowance", own_allowed, self._eth("xrt_allowance")),
            (TOKEN, "/eth/erc20_balance", balance, self._eth("account_xrt_balance", XRT.decimals)),
            (TOKEN, "/eth/erc20_balance_of", own, self._eth("xrt_balance", XRT.decimals)),
            (TOKEN, "/eth/erc20_allowance", allowed, self._eth("account_xrt_allowance")),
            (TOKEN, "/eth/erc20_allowance_of", own_allowed, self._eth("xrt_allowance")),
        ]
        for node, name, type, handler in handlers:
            versions = service_types()[type]
            default = versions[md5_of(type, self._generation)]
            await self._nodes[node].serve(name, default, handler, versions.values())

    def _handle_event(self, key: str, payload: bytes) -> None:
        """A job has come to a phase."""
        try:
            event = parse_agent_key(key)
            if not isinstance(event, EventKey):
                return
            liability = Liability.decode(payload)
        except AiraError as error:
            log.info("%s", error, extra=log_event("key-ignored", key=key))
            return
        address, phase = liability.address, event.event
        if self._phases.get(address) == phase:
            return
        self._phases[address] = phase
        shown = _encoded(liability)
        ready = self._topics["/liability/ready"]
        if phase == "ready":
            ready.kept[address] = shown  # also for a node that starts late
        else:
            ready.kept.pop(address, None)
        if phase == "complete":
            self._complete[address] = True
            self._jobs.ended(address)
        if phase == "finalized":
            self._jobs.ended(address)
            self._topics["/liability/finalized"].publish({"data": address})
        else:
            self._topics[f"/liability/{phase}"].publish(shown)

    async def _recall_jobs(self) -> None:
        """Show the jobs that are ready already, as after a restart of this bridge, and no running ones."""

        with suppress(zenoh.ZError, AiraError):
            found = await self._ask_jobs()
            # The agent calls running jobs ready, too: it says only how many are.
            status = await call(self._session, self._agent, "status", Nothing())
            are_ready = status.work is not None and status.work.jobs.get("ready", 0)
            for key, payload in found.items():
                below, _, event = key.rpartition("/")
                is_waiting = are_ready and event == "ready" and f"{below}/progress" not in found
                if is_waiting or event == "complete":
                    self._handle_event(key, payload)

    async def _ask_jobs(self, liability: str = "*") -> dict[str, bytes]:
        """What the agent answers about a job, or about all that have not ended, by key. Raises `ZError`."""

        def ask() -> dict[str, bytes]:
            replies = self._session.get(event_selector(self._agent, liability), timeout=LEGACY_LIMITS.answer)
            found = (reply.ok for reply in replies)
            return {str(each.key_expr): each.payload.to_bytes() for each in found if each is not None}

        return await asyncio.to_thread(ask)

    def _handle_token_event(self, key: str, payload: bytes) -> None:
        kind = key.rpartition("/")[2]
        record: type[Record] = TransferEvent if kind == "transfer" else ApprovalEvent
        with suppress(AiraError):
            self._topics[f"/eth/event/{kind}"].publish(msgspec.structs.asdict(record.decode(payload)))

    async def _show_market(self, kind: type[Demand | Offer | Result]) -> None:
        """Publish the market's messages; those of the agent also as what its signer sends."""
        name, loop = kind.__name__.lower(), asyncio.get_running_loop()
        async with self._channel.subscribe(kind) as messages:
            async for verified in messages:
                values = fields_of(verified.message)
                incoming = self._topics[f"/liability/infochan/incoming/{name}"]
                incoming.publish(values)
                if len(incoming.kept) < LEGACY_LIMITS.kept:  # nodes that have just started connect within seconds
                    incoming.kept[verified.hash.hex()] = values
                    loop.call_later(LEGACY_LIMITS.kept_seconds, incoming.kept.pop, verified.hash.hex(), None)
                if verified.signer != self._agent:
                    continue
                self._topics[f"/liability/infochan/eth/sending/{name}"].publish(values)
                if name == "result" and self._complete.pop(values["liability"], False):
                    self._topics["/liability/result"].publish(values | {"signature": b""})

    async def _show_feedback(self, kind: type[OrderFeedback | TransactionFeedback]) -> None:
        """Publish what providers say about orders. Nothing in it can be verified."""
        topic = self._topics[FEEDBACK[kind][0]]

        def decoded(sample: zenoh.Sample) -> dict[str, Any] | None:  # runs on the pump's thread
            try:
                message = decode(sample.payload.to_bytes())
            except AiraError:
                return None
            return feedback_fields(message) if isinstance(message, kind) else None

        selector = market_selector(self._channel.lighthouse, kind.kind)
        async with Pump(self._session, selector, decoded, drops=self._nodes[CHANNEL].drops) as pump:
            async for values in pump:
                topic.publish(values)

    def _request(self, service: str, type: str, payload: bytes, header: Mapping[str, str]) -> None:
        """A node wants a message signed, or sent."""
        try:
            kind = message_types()[type].get(header.get("md5sum", ""))
            if kind is None:
                raise InputError(f"{type} of an unknown version, {header.get('md5sum')}")
            values = {name: plain(value) for name, value in kind.decode(payload).items()}
            self._requests.put_nowait((service, values))
        except (AiraError, asyncio.QueueFull) as error:
            self._refuse(service, header.get("callerid", ""), error)

    async def _send_requests(self) -> None:
        while True:
            service, values = await self._requests.get()
            try:
                request = SERVICES[service].request.decode(msgspec.json.encode(self._request_of(service, values)))
                await call(self._session, self._agent, service, request)
            except AiraError as error:
                self._refuse(service, "", error)

    def _request_of(self, service: str, values: dict[str, Any]) -> dict[str, Any]:
        """The fields of a request to the agent: amounts as text, and no nonce and signature if it shall sign."""
        fields = {name: str(value) or "0" if name in AMOUNTS else value for name, value in values.items()}
        nonce: Any = fields.pop("nonce", b"")
        signature: Any = fields.pop("signature", b"")
        sender = fields.pop("sender", "")
        if "cost" in fields:
            fields["lighthouse"] = fields.get("lighthouse") or self._channel.lighthouse
            fields["validator"] = fields["validator"] or ZERO_ADDRESS
        if service.startswith("sign/"):
            return fields
        if "cost" in fields:
            fields["nonce"] = nonce.hex() if isinstance(nonce, bytes) else nonce
            fields |= {"sender": sender} if sender else {}
        return fields | {"signature": signature.hex()}

    def _refuse(self, service: str, node: str, error: Exception) -> None:
        code = error.code if isinstance(error, AiraError) else "busy"
        facts = log_event("ros1-message-refused", service=service, node=node, code=code)
        hint = f"; {error.hint}" if isinstance(error, AiraError) and error.hint else ""
        log.warning("a message of a ROS node for %s is refused: %s%s", service, error, hint, extra=facts)

    async def _drive(self, service: str, request: Mapping[str, Any], caller: str) -> dict[str, Any]:
        """Start, restart or resume a job for a node."""
        address = plain(request)
        try:
            address = parse_address(address)
            asked = SERVICES[service].request(address)
            done = await call(self._session, self._agent, service, asked)
        except AiraError as error:
            return {"success": False, "msg": str(error)}
        if done.success:
            self._jobs.driven(address, caller)
        return {"success": done.success, "msg": done.msg or f"Liability {address} started"}

    async def _finish(self, request: Mapping[str, Any], _caller: str) -> dict[str, Any]:
        address = parse_address(plain(request["address"]))
        await self._jobs.settle()
        asked = SERVICES["finish"].request(address, request["success"])
        await call(self._session, self._agent, "finish", asked)
        return {}

    async def _read(self, request: Mapping[str, Any], _caller: str) -> dict[str, Any]:
        asked = SERVICES["read"].request(parse_address(plain(request)))
        found = await call(self._session, self._agent, "read", asked)
        if found.liability is None:
            return {"read": False}
        return {"read": True, "liability": _encoded(found.liability)}

    async def _exists(self, request: Mapping[str, Any], _caller: str) -> dict[str, Any]:
        """Whether the agent has a job that has not ended."""
        found = await self._ask_jobs(parse_address(plain(request)))
        return {"exists": any(key.endswith(("/incoming", "/ready")) for key in found)}

    async def _played_until(self, request: Mapping[str, Any], _caller: str) -> dict[str, Any]:
        """The time in its objective of what was played last in a job; 0 if that is not known, as in the original."""
        found = await self._ask_jobs(parse_address(plain(request)))
        by_event = {key.rpartition("/")[2]: payload for key, payload in found.items()}
        if not by_event.keys() >= {"ready", "progress"}:
            return {}
        done = PlaybackPosition.decode(by_event["progress"]).position
        cid = Liability.decode(by_event["ready"]).objective
        path = await self._exchange.fetch(cid, size_limit=self._size_limit, timeout=LEGACY_LIMITS.fetch)

        def last_time() -> int:
            played = open_objective(path).messages(from_index=max(done - 1, 0))
            return next((one.log_time_ns for one in played), 0) if done else 0

        return {"timestamp": divmod(await asyncio.to_thread(last_time), 10**9)}

    def _eth(self, service: str, places: int | None = None) -> Handler:
        """A service of the agent's account; `places` says of a balance where its decimal point is."""

        async def handler(request: Mapping[str, Any], _caller: str) -> dict[str, Any]:
            kind = SERVICES[f"eth/{service}"].request
            fields = {name: plain(value) for name, value in request.items()}
            asked = kind.decode(msgspec.json.encode(fields))
            reply = msgspec.structs.asdict(await call(self._session, self._agent, f"eth/{service}", asked))
            if places is not None:
                reply["balance"] = decimal(reply["balance"], places)
            if "txhash" in reply:
                reply["txhash"] = bytes.fromhex(reply["txhash"].removeprefix("0x"))
            return reply

        return handler


def decimal(amount: int, places: int) -> str:
    """An amount of the smallest unit as the legacy services wrote it: `997.0`."""
    text = f"{Decimal(int(amount)).scaleb(-places):f}"
    whole, _, part = text.partition(".")
    return f"{whole}.{part.rstrip('0') or '0'}"


def _encoded(message: msgspec.Struct) -> dict[str, Any]:
    """The fields by the names that travel, as ROS has them, too."""
    return dict(zip(message.__struct_encode_fields__, msgspec.structs.astuple(message), strict=True))


def fields_of(message: Demand | Offer | Result) -> dict[str, Any]:
    """The fields of a message for any generation."""
    fields = _encoded(message)
    fields["signature"] = bytes.fromhex(message.signature.removeprefix("0x"))
    if isinstance(message, Demand | Offer):
        nonce = message.nonce
        fields["nonce"] = Nonce(nonce.to_bytes(32, "big") if isinstance(nonce, int) else bytes.fromhex(nonce))
        fields["sender"] = message.sender or ""
    return fields


def feedback_fields(message: OrderFeedback | TransactionFeedback) -> dict[str, Any]:
    if isinstance(message, TransactionFeedback):
        return {"tx": message.tx}
    signature = bytes.fromhex(message.signature.removeprefix("0x"))
    return {"order": bytes.fromhex(message.order), "accepted": message.accepted, "signature": signature}


def _type_of(kind: str) -> str:
    return f"robonomics_msgs/{kind.capitalize()}"


FILES_NODE: Final = "/liability/infochan/ipfs_common_node"
PLAYER_NODE: Final = "/liability/player_service"


@dataclass(eq=False)
class _Player:
    """A bag that is played below a namespace, while everything there is recorded."""

    objective: Objective
    namespace: str
    recorder: Recorder
    task: asyncio.Task[None] | None = None


class LegacyFiles(Lifecycle):
    """The services for files on two of the `nodes`: `async with LegacyFiles(...)`."""

    title = "files on ROS 1"

    def __init__(self, parts: RosBridgeParts, options: RosBridgeOptions, nodes: Mapping[str, Ros1Node]) -> None:
        self._parts = parts
        self._options = options
        self._files = nodes[FILES_NODE]
        self._player = nodes[PLAYER_NODE]
        self._folders = tuple(folder.resolve() for folder in options.folders)
        self._players: dict[str, _Player] = {}

    async def _open(self, stack: AsyncExitStack) -> None:
        self._tasks = await stack.enter_async_context(Background())
        stack.push_async_callback(self._stop_all)
        for node, name, type, handler in (
            (self._files, "/ipfs/add_file", "ipfs_common/IpfsUploadFile", self._add),
            (self._files, "/ipfs/get_file", "ipfs_common/IpfsDownloadFile", self._get),
            (self._player, "/rosbagplayer/new", "robonomics_liability/CreateRosbagPlayer", self._new),
            (self._player, "/rosbagplayer/start", "robonomics_liability/StartRosbagPlayer", self._start),
            (self._player, "/rosbagplayer/stop", "robonomics_liability/StopRosbagPlayer", self._stop),
        ):
            versions = service_types()[type]
            default = versions[md5_of(type, self._options.generation)]
            await node.serve(name, default, handler, versions.values())

    def _checked(self, text: str) -> Path:
        """A path below one of the folders. Raises `InputError`."""
        path = Path(text).resolve()
        if not any(path.is_relative_to(folder) for folder in self._folders):
            raise InputError(f"{text} is in no folder that the bridge may use: start it with --files FOLDER")
        return path

    async def _add(self, request: Mapping[str, Any], _caller: str) -> dict[str, Any]:
        try:
            cid = await asyncio.to_thread(self._parts.store.put_file, self._checked(plain(request)), pin="ros1")
        except (AiraError, OSError) as error:
            return {"success": False, "error_msg": str(error)}
        return {"success": True, "ipfs_address": cid}

    async def _get(self, request: Mapping[str, Any], _caller: str) -> dict[str, Any]:
        try:
            target = self._checked(plain(request["file"]))
            found = await self._fetch(plain(request["ipfs_address"]))
            await asyncio.to_thread(shutil.copyfile, found, target)
        except (AiraError, OSError) as error:
            return {"success": False, "error_msg": str(error)}
        return {"success": True}

    async def _fetch(self, cid: str) -> Path:
        return await self._parts.exchange.fetch(cid, size_limit=self._options.size_limit, timeout=LEGACY_LIMITS.fetch)

    async def _new(self, request: Mapping[str, Any], _caller: str) -> dict[str, Any]:
        cid, namespace = plain(request["ipfs_address"]), request["namespace"]
        try:
            if len(self._players) >= LEGACY_LIMITS.players:
                why = f"there are {LEGACY_LIMITS.players} players already"
                raise InputError(why, hint="stop one: /rosbagplayer/stop")
            namespace = resolve(namespace, "/")
            objective = await asyncio.to_thread(open_objective, await self._fetch(cid))
            name = f"{cid}{namespace.replace('/', '_')}_{secrets.token_hex(4)}"
            self._parts.directory.mkdir(parents=True, exist_ok=True)
            about = RecordingAbout(objective=cid)
            recorder = await asyncio.to_thread(Recorder, self._parts.directory / f"{name}.mcap", about)
        except (AiraError, OSError) as error:
            return {"success": False, "error_msg": str(error)}
        self._players[name] = _Player(objective, namespace, recorder)
        return {"success": True, "player_id": name}

    async def _start(self, request: Mapping[str, Any], _caller: str) -> dict[str, Any]:
        name = request["player_id"]
        player = self._players.get(name)
        if player is None or player.task is not None:
            return {"success": False, "msg": f"no player {name} that could be started"}
        player.task = self._tasks.start(self._run(player), f"player {name}")
        return {"success": True, "msg": f"player {name} started"}

    async def _stop(self, request: Mapping[str, Any], _caller: str) -> dict[str, Any]:
        player = self._players.pop(request["player_id"], None)
        if player is None:
            return {"success": False}
        await self._end(player)
        cid = await asyncio.to_thread(self._parts.store.put_file, player.recorder.path, pin="ros1")
        await asyncio.to_thread(player.recorder.path.unlink)
        return {"success": True, "ipfs_address": cid}

    async def _run(self, player: _Player) -> None:
        subscriptions: dict[str, Ros1Subscription] = {}
        publishers: dict[str, Ros1Publisher] = {}
        await self._listen(player, subscriptions)
        recording = asyncio.create_task(self._record(player, subscriptions), name="record a player's topics")
        try:
            async for step in play(player.objective):
                message = step.message
                if message.topic not in publishers:
                    topic = f"{player.namespace}{message.topic}"
                    publishers[message.topic] = await advertise(self._player, topic, message.type)
                    await publishers[message.topic].wait_for_subscriber(TOPIC_PACE.subscriber)
                publishers[message.topic].publish(message.payload)
                player.recorder.record(message.topic, message.payload, message.type, role="objective")
            await asyncio.Event().wait()  # it records until it is stopped
        except AiraError as error:
            log.warning("a player of bags failed: %s", error, extra=log_event("ros1-player-failed", code=error.code))
        finally:
            recording.cancel()
            for publisher in publishers.values():
                await publisher.close()
            for subscription in subscriptions.values():
                await subscription.close()

    async def _record(self, player: _Player, subscriptions: dict[str, Ros1Subscription]) -> None:
        """Record what other nodes publish below the namespace."""
        while True:
            await asyncio.sleep(TOPIC_PACE.look)
            await self._listen(player, subscriptions)

    async def _listen(self, player: _Player, subscriptions: dict[str, Ros1Subscription]) -> None:
        """Subscribe to the topics below the namespace that the graph has now."""
        topics = await self._player.graph.topics(player.namespace) or {}
        for topic in topics.keys() - subscriptions.keys():
            received = partial(self._received, player, topic.removeprefix(player.namespace))
            subscriptions[topic] = await self._player.subscribe(topic, topics[topic], received)

    def _received(self, player: _Player, topic: str, payload: bytes, header: Mapping[str, str]) -> None:
        try:
            player.recorder.record(topic, payload, type_in(header), role="device")
        except AiraError as error:
            log.info("can't record %s: %s", topic, error, extra=log_event("message-not-recorded", key=topic))

    async def _end(self, player: _Player) -> None:
        if player.task is not None:
            player.task.cancel()
            await asyncio.wait([player.task])
        await asyncio.to_thread(player.recorder.close)

    async def _stop_all(self) -> None:
        for player in self._players.values():
            await self._end(player)
