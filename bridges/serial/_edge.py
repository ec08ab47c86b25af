"""The edge agent: serves a board's topics as keys of its agent. A session, a line and signals; no event loop.

Outside a job a topic is `aira/agent/{address}/device/{device}/{topic}`; messages of a job use the liability's topics
and are recorded. A put is a command without a reply; a query is a call, whose reply reports how it ended. While the
board answers, its liveliness token is on the topic `/present`. A query for `/aira/idle` is answered when the board
has ended all commands and calls that came before it. A query for `/aira/stop` drops the commands that wait for the
board, and calls its topic `/stop` before anything else.

If several devices of an agent share a topic's name, a call reaches the one that its parameter `device` names, a command
in a job all of them. Edge agents mark what they put, so that others don't take it for a command.
"""

from __future__ import annotations

import logging
import signal
import sys
import threading
import time
from collections import Counter
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import msgspec
import zenoh

from bridges.devices import (
    ABOUT,
    CONNECTION,
    LOG,
    PUT_BY_EDGE,
    DeviceAbout,
    DeviceTopic,
    JobTracker,
    answer_log_queries,
    is_put_by_edge,
    said_by,
)
from bridges.serial import dialect as events
from bridges.serial.dialect import (
    AUTO,
    COMMAND_LIMITS,
    REASONS,
    BoardTopic,
    CallStatus,
    Command,
    CommandRefused,
    Flow,
    make_dialect,
)
from bridges.serial.line import PortName, SerialLine
from mesh.base.log_context import LogSource, liability_context, log_event
from mesh.cli.output import announce
from mesh.errors import InvalidKey, public_text
from mesh.network import sending
from mesh.network.endpoints import SessionOpening
from mesh.role.local_stop import ANSWER_SECONDS, LocalAnswer, LocalRequest, listening, stop_folder
from mesh.role.running import INTERRUPTED, file_delays
from mesh.telemetry.logs import set_process_source
from mesh.telemetry.metrics import STARTING, Health, MetricFamily, by_label, counter, gauge, health_metrics
from schemas.address import parse_address
from schemas.errors import InvalidPayload
from schemas.keys import (
    IDLE,
    PRESENT,
    STOP,
    DeviceTopicKey,
    LiabilityTopicKey,
    event_selector,
    parse_agent_key,
    topic_chunks,
    topic_selector,
)
from schemas.payloads import EMPTY, STRING, Empty, PayloadType, String, decode_value, encode_as, payload_type
from schemas.records import DeviceStop
from schemas.status import ALIVE

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from bridges.serial.dialect import DeviceInfo, LineCounters, LineEvent
    from mesh.network.endpoints import Endpoints
    from mesh.settings import Settings

log = logging.getLogger(__name__)

STOP_TOPIC: Final = "/stop"
"""The topic, by its name on the board, on which a board hears that it must stop: std_msgs/Empty, or std_msgs/String for
the reason."""
LONGEST_STOP: Final = 60
"""Characters of the reason for a stop that a board gets: it may have room for no more."""
ANSWER: Final = "/answer"
"""The topic below a called one on which a job's recording has what the board answered."""


@dataclass(frozen=True, kw_only=True)
class EdgeOptions:
    """A board: its agent's address and its name in the mesh, how it is reached, and the protocol that it speaks.

    `baud` is in bits per second, 0 if it has to be found, as is the `protocol` "auto"; a command waits at most
    `patience` seconds for a board that is absent or busy; after `agent_silence` seconds (0: never) without an answer
    of the agent in a job the edge agent stops the board by itself; `parameters` are values that firmware may request;
    `rename` returns the name in the mesh of a topic of the board.
    """

    agent: str
    name: str = "board"
    port: str
    protocol: str = AUTO
    baud: int = 0
    patience: float = COMMAND_LIMITS.patience
    agent_silence: float = 0.0
    parameters: Mapping[str, object] = field(default_factory=dict)
    rename: Callable[[str], str] = str


def edge_families(
    line: LineCounters, calls: Mapping[str, int], *, openings: int, losses: int, is_present: bool
) -> tuple[MetricFamily, ...]:
    """The metrics of a board: what went over its line, how commands and calls ended (`done`, `read`, or the reason of a
    failure), how often the port was opened (once, and after each loss), and how often a present board was lost."""
    faults = {name: getattr(line, name) for name in ("damaged", "refused", "missed", "repeated", "stray")}
    ways = {"in": line.received, "out": line.sent}
    of_frames = "Whole frames from the board and to it"
    of_faults = "Frames that are damaged, undecodable, missing, repeated, or unrequested"
    of_openings = "How often the port was opened: once, and after each loss"
    return (
        by_label("aira_edge_frames_total", "counter", of_frames, "direction", ways),
        by_label("aira_edge_frame_faults_total", "counter", of_faults, "reason", faults),
        counter("aira_edge_noise_bytes_total", "Bytes on the line that belong to no frame", line.noise),
        by_label("aira_edge_calls_total", "counter", "Commands and calls, by outcome", "outcome", calls),
        counter("aira_edge_line_openings_total", of_openings, openings),
        counter("aira_edge_board_losses_total", "How often a present board was lost", losses),
        gauge("aira_edge_board_present", "1 while the board is present, 0 otherwise", float(is_present)),
    )


class Edge:
    """A board in the mesh, as a device of its agent.

    `run` blocks its thread and needs no event loop. Raises `InputError` for an invalid port's name or protocol,
    `InvalidKey` for an invalid agent or name.
    """

    def __init__(self, options: EdgeOptions) -> None:
        self.options: Final = options
        self._session: Any = None
        """Opened by `run`."""
        self._key(PRESENT)
        port, dialect = PortName(options.port), make_dialect(options.protocol, options.baud, options.parameters)
        self._line = SerialLine(port, dialect, on_event=self._on_event)
        self._jobs = JobTracker()
        self._pending: dict[Command, zenoh.Query | None] = {}
        """The commands that have not ended, each with the call that waits for its outcome, if it is one."""
        self._stops: dict[Command, Callable[[str], None]] = {}
        """The calls of `/stop` that have not ended, and what is called with the reason if the board did not hear it."""
        self._until_idle: list[zenoh.Query] = []
        """The queries that wait until there are none."""
        self._outcomes: Counter[str] = Counter()
        self._board_losses = 0
        self._ended = threading.Event()
        self._declared: dict[str, list[Any]] = {}
        self._token: Any = None
        self._said_by = said_by(options.name)
        self._name_of: dict[BoardTopic, str] = {}
        """The names of topics in the mesh; empty for those that are not used."""
        self._commandable: dict[str, BoardTopic] = {}

    def run(self, session: zenoh.Session) -> None:
        """Serve on an open session until `stop`; once."""
        self._session, agent = session, self.options.agent
        subscriber: Any = session.declare_subscriber(event_selector(agent), self._on_job_event)
        # An edge agent that starts during a job learns of it.
        session.get(event_selector(agent), self._on_present_job, timeout=COMMAND_LIMITS.patience)
        about: Any = session.declare_queryable(self._key(ABOUT), partial(self._soon, self._reply_about))
        idle: Any = session.declare_queryable(self._key(IDLE), partial(self._soon, self._reply_when_idle))
        stop: Any = session.declare_queryable(self._key(STOP), partial(self._soon, self._reply_when_stopped))
        if self.options.agent_silence:
            threading.Thread(target=self._watch_agent, args=(session,), name="agent's silence", daemon=True).start()
        try:
            self._line.run()
        finally:
            self._ended.set()
            for query in (*filter(None, self._pending.values()), *self._until_idle):
                query.drop()  # type: ignore[no-untyped-call]
            if not session.is_closed():
                for declared in (
                    subscriber,
                    about,
                    idle,
                    stop,
                    *(one for some in self._declared.values() for one in some),
                ):
                    declared.undeclare()
                self._withdraw_token()

    def stop(self) -> None:
        """End `run`; from any thread, and from a signal handler."""
        self._line.stop()

    def families(self) -> tuple[MetricFamily, ...]:
        dialect, openings = self._line.dialect, self._line.openings
        counts = (replace(dialect.counters), dict(self._outcomes))  # they change on the line's thread
        present = dialect.info is not None
        families = edge_families(*counts, openings=openings, losses=self._board_losses, is_present=present)
        return (*families, health_metrics(self.parts()))

    def parts(self) -> Mapping[str, str]:
        if self._session is None:
            return {"start": STARTING}
        linked = not self._session.is_closed() and bool(self._session.info.routers_zid())
        return {
            "channel": ALIVE if linked else "waits for a router",
            "line": ALIVE if self._line.is_open else "waits for the port",
            "board": ALIVE if self._line.dialect.info is not None else "is absent",
        }

    def _on_event(self, event: LineEvent) -> None:
        if isinstance(event, events.MessageReceived):
            self._publish(event.topic, event.payload)
            return
        with liability_context(self._jobs.current):
            match event:
                case events.BoardReady(info):
                    self._board_ready(info)
                case events.BoardLost(reason):
                    self._board_losses += 1
                    log.warning("the board is absent: %s", reason, extra=log_event("board-lost", reason=reason))
                    self._record_connection(f"absent: {reason}")
                    self._withdraw_token()
                case events.CommandFinished():
                    self._command_finished(event)
                case events.BoardLogged(level, text):
                    log.log(level, "the board says: %s", text, extra=log_event("board-logged"))

    def _board_ready(self, info: DeviceInfo) -> None:
        """Declare the board's topics in the mesh, and its presence."""
        self._name_of = {}
        for topic in info.topics:
            self._name_of[topic] = self._valid_name(topic)
        named = [(topic, name) for topic, name in self._name_of.items() if name]
        accepting = [(topic, name) for topic, name in named if topic.flow in (Flow.SUBSCRIBES, Flow.SERVES)]
        self._commandable = {name: topic for topic, name in reversed(accepting)}
        for topic, name in accepting:
            if self._commandable[name] is not topic:
                facts = {"topic": topic.name, "name": name}
                log.warning("%(name)s is another topic's name, too", facts, extra=log_event("topic-shadowed", **facts))
        for name in self._declared.keys() - self._commandable.keys():
            for declared in self._declared.pop(name):
                declared.undeclare()
        for name in self._commandable.keys() - self._declared.keys():
            self._declared[name] = self._declare(name)
        self._record_connection("present")
        if self._token is None:
            self._token = self._session.liveliness().declare_token(self._key(PRESENT))
        topics = ", ".join(name for _, name in named) or "no topics"
        ready = log_event("board-ready", name=info.name, version=info.version, topics=topics)
        title = " ".join(filter(None, ("the board", info.name, info.version)))
        log.info("%s is present: %s", title, topics, extra=ready)

    def _valid_name(self, topic: BoardTopic) -> str:
        """The name of a topic in the mesh; empty if that is invalid, or an earlier topic of that direction has it with
        another type."""
        why = ""
        try:
            name = topic_chunks(self.options.rename(topic.name))
        except InvalidKey as error:
            why = str(error)
        else:
            same = ((one.type, one.flow) for one, taken in self._name_of.items() if taken == name)
            first = next((type for type, flow in same if flow is topic.flow), topic.type)
            if first == topic.type:
                return name
            kinds = f"{first.schema_name or first.encoding} and {topic.type.schema_name or topic.type.encoding}"
            why = f"it has two types, {kinds}; the first one is used, so rename the other topic"
        rejected = log_event("topic-rejected", topic=topic.name, id=topic.id)
        log.error("topic %s of the board is not used: %s", topic.name, why, extra=rejected)
        return ""

    def _declare(self, name: str) -> list[Any]:
        """Subscribe to commands and calls on a topic, in jobs and outside."""
        keys = (self._key(name), topic_selector(self.options.agent, topic=name))
        return [
            *(self._session.declare_subscriber(key, self._on_command) for key in keys),
            *(self._session.declare_queryable(key, partial(self._soon, self._call)) for key in keys),
        ]

    def _withdraw_token(self) -> None:
        token, self._token = self._token, None
        if token is not None:
            token.undeclare()

    # Zenoh's callbacks run on its threads, and pass their work to the line's thread.

    def _on_job_event(self, sample: zenoh.Sample) -> None:
        self._line.call_soon(partial(self._jobs.handle_event, str(sample.key_expr)))

    def _on_present_job(self, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._on_job_event(reply.ok)

    def _on_command(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT and not is_put_by_edge(sample.attachment):
            given = payload_type(str(sample.encoding))
            self._line.call_soon(partial(self._command, str(sample.key_expr), sample.payload.to_bytes(), given))

    def _soon(self, reply: Callable[[zenoh.Query], None], query: zenoh.Query) -> None:
        self._line.call_soon(partial(reply, query))

    def _command(self, key: str, payload: bytes, given: PayloadType) -> None:
        topic, job = self._topic_of(key)
        if topic is None:
            return
        try:
            self._submit(topic, convert(payload, given, topic.type), self.options.patience)
        except CommandRefused as error:
            with liability_context(job):
                log.warning("%s", error, extra=log_event("command-rejected", topic=topic.name, code=error.code))

    def _call(self, query: zenoh.Query) -> None:
        """Submit a call; it is also put into its job's recording. One for another device is not answered here."""
        key = str(query.key_expr)
        is_ours = query.parameters.get("device") in (None, self.options.name)
        topic, job = self._topic_of(key) if is_ours else (None, "")
        if topic is None:
            query.drop()  # type: ignore[no-untyped-call]
            return
        payload = b"" if query.payload is None else query.payload.to_bytes()
        payload = convert(payload, payload_type(str(query.encoding or "")), topic.type)
        try:
            self._submit(topic, payload, _timeout_of(query, self.options.patience), query)
        except CommandRefused as error:
            self._outcomes[error.reason] += 1
            _reply_failure(query, error.reason, str(error))
            return
        if job:
            self._put(key, payload, topic.type if payload else EMPTY)  # nothing is no JSON

    def _submit(self, topic: BoardTopic, payload: bytes, patience: float, query: zenoh.Query | None = None) -> None:
        now = time.monotonic()
        command = Command(topic.name, payload, now + patience)
        self._line.dialect.submit(command, now)
        self._pending[command] = query

    def _command_finished(self, finished: events.CommandFinished) -> None:
        """Count the outcome of a command; if it was a call, record the answer in its job, and reply."""
        query = self._pending.pop(finished.command, None)
        if (end := self._stops.pop(finished.command, None)) is not None:
            end(finished.detail if finished.status is CallStatus.FAILED else "")
        self._outcomes[finished.reason or finished.status.value] += 1
        if finished.status is CallStatus.FAILED:
            failed = log_event("command-failed", topic=finished.command.topic, reason=finished.reason)
            log.warning("%s: %s (%s)", finished.command.topic, finished.detail, finished.reason, extra=failed)
        if query is not None:
            self._record_answer(str(query.key_expr), finished)
            _reply(query, finished)
        self._reply_if_idle()

    def stop_board(self, why: str, on_end: Callable[[DeviceStop], None]) -> None:
        """Drop the commands that wait for the board and call its topic `/stop`. On the line's thread.

        `on_end` is called when the board has heard it, or can't hear it.
        """

        def end(why_not: str = "") -> None:
            if why_not:
                log.error("the board has not heard the stop: %s", why_not, extra=log_event("stop-unheard"))
            on_end(DeviceStop(device=self.options.name, heard=not why_not, detail=why_not))

        dialect, now = self._line.dialect, time.monotonic()
        log.warning("told to stop: %s", why, extra=log_event("device-stopped"))
        dialect.drop_queued(now)
        if dialect.info is None:
            end("the board is absent")
            return
        flows = (Flow.SUBSCRIBES, Flow.SERVES)
        topic = next((one for one in dialect.info.topics if one.name == STOP_TOPIC and one.flow in flows), None)
        if topic is None:
            end(f"its firmware has no topic {STOP_TOPIC}")
            return
        said = String(why[:LONGEST_STOP]).encode()
        payload = b"" if topic.type == EMPTY else convert(said, STRING, topic.type)
        command = Command(topic.name, payload, now + self.options.patience)
        try:
            dialect.submit(command, now)
        except CommandRefused as error:
            end(str(error))
            return
        self._stops[command] = end
        if (job := self._jobs.current) and (name := self._name_of.get(topic, "")):
            self._put(self._job_key(job, name), payload, topic.type)

    def stop_from_thread(self, asked: LocalRequest) -> LocalAnswer:
        """The same from any thread; returns when the board has heard it, can't hear it, or takes too long."""
        outcome: Future[DeviceStop] = Future()
        self._line.call_soon(partial(self.stop_board, asked.why, outcome.set_result))
        try:
            ended = outcome.result(ANSWER_SECONDS - 1)
        except TimeoutError:
            detail = "the board is busy and has not confirmed the stop yet"
            ended = DeviceStop(device=self.options.name, heard=False, detail=detail)
        who = f"device {ended.device} of {self.options.agent}"
        return LocalAnswer(who=who, heard=ended.heard, detail=ended.detail)

    def _watch_agent(self, session: zenoh.Session) -> None:
        """Stop the board once the agent has been silent for too long in a job, each time. On a thread of its own."""
        silence, is_told = self.options.agent_silence, False
        heard, interval = time.monotonic(), silence / 4  # so it is asked four times before it is thought to be gone
        while not self._ended.wait(interval):
            job = self._jobs.current
            with suppress(zenoh.ZError):  # a closed session has no answers
                asked = event_selector(self.options.agent, job) if job else ""
                if not job or any(one.ok for one in session.get(asked, timeout=interval)):
                    heard, is_told = time.monotonic(), False
            if not is_told and time.monotonic() - heard >= silence:
                is_told, why = True, f"the agent has been silent for {silence:g} s in a job"
                self._line.call_soon(partial(self.stop_board, why, lambda _outcome: None))

    def _reply_when_stopped(self, query: zenoh.Query) -> None:
        def reply(outcome: DeviceStop) -> None:
            with query:
                query.reply(str(query.key_expr), outcome.encode(), encoding="application/json", express=True)

        why = ""
        with suppress(InvalidPayload):
            why = String.decode(b"" if query.payload is None else query.payload.to_bytes()).data
        self.stop_board(public_text(why), reply)

    def _reply_when_idle(self, query: zenoh.Query) -> None:
        self._until_idle.append(query)
        self._reply_if_idle()

    def _reply_if_idle(self) -> None:
        if self._pending:
            return
        waiting, self._until_idle = self._until_idle, []
        for query in waiting:
            with query:
                query.reply(str(query.key_expr), b"")

    def _topic_of(self, key: str) -> tuple[BoardTopic | None, str]:
        """The topic that a key names, and its job if it has one; that job becomes the current one."""
        try:
            parsed = parse_agent_key(key)
        except InvalidKey as error:
            log.info("%s", error, extra=log_event("key-ignored", key=key))
            return None, ""
        if not isinstance(parsed, LiabilityTopicKey | DeviceTopicKey) or parsed.topic not in self._commandable:
            return None, ""
        topic = self._commandable[parsed.topic]
        if isinstance(parsed, DeviceTopicKey):
            return topic, ""
        self._jobs.begin(parsed.liability)
        return topic, parsed.liability

    def _publish(self, topic: BoardTopic, payload: bytes) -> None:
        """Put a board's message on its topic of the current job, or of the device; or forward its request."""
        if topic not in self._name_of:  # a dialect may publish on topics that no board announces
            self._name_of[topic] = self._valid_name(topic)
        if not (name := self._name_of[topic]):
            return
        if topic.flow is Flow.REQUESTS:
            self._request(topic, self._key(name), payload)
        else:
            key = self._job_key(job, name) if (job := self._jobs.current) else self._key(name)
            self._put(key, payload, topic.type, attachment=self._said_by)

    def _request(self, topic: BoardTopic, key: str, payload: bytes) -> None:

        def on_reply(answer: zenoh.Reply) -> None:
            if answer.ok is not None:
                data = answer.ok.payload.to_bytes()
                self._line.call_soon(lambda: self._line.dialect.respond(topic, data, time.monotonic()))

        self._session.get(key, on_reply, payload=payload)

    def _record_connection(self, text: str) -> None:
        """Add a loss or return of the device to the recording of the current job, if there is one."""
        if job := self._jobs.current:
            self._put(self._job_key(job, f"{CONNECTION}/{self.options.name}"), String(text).encode(), STRING)

    def _record_answer(self, key: str, finished: events.CommandFinished) -> None:
        """Add what the board answered to a call to the recording of the call's job; nothing and null are left out."""
        if finished.type is None or finished.payload in (b"", b"null"):
            return
        if isinstance(called := parse_agent_key(key), LiabilityTopicKey):
            self._put(self._job_key(called.liability, called.topic + ANSWER), finished.payload, finished.type)

    def _reply_about(self, query: zenoh.Query) -> None:
        dialect, info = self._line.dialect, self._line.dialect.info
        about = DeviceAbout(
            name="" if info is None else info.name,
            version="" if info is None else info.version,
            present=info is not None,
            port=str(self._line.name),
            job=self._jobs.current,
            topics=tuple(
                DeviceTopic(name, topic.flow.value, topic.type.schema_name or topic.type.encoding)
                for topic, name in self._name_of.items()
                if name
            ),
            counters=vars(dialect.counters),
        )
        about.reply(query)

    def _key(self, topic: str) -> str:
        """The key of a topic outside any job. Raises `InvalidKey`."""
        return str(DeviceTopicKey(self.options.agent, self.options.name, topic))

    def _job_key(self, liability: str, topic: str) -> str:
        return str(LiabilityTopicKey(self.options.agent, liability, topic))

    def _put(self, key: str, payload: bytes, kind: PayloadType, *, attachment: bytes = PUT_BY_EDGE) -> None:
        sending.put(self._session, key, payload, encoding=kind.zenoh_encoding, attachment=attachment)


def _timeout_of(query: zenoh.Query, default: float) -> float:
    """The seconds that the caller wants to wait: the parameter `timeout`."""
    try:
        seconds = float(query.parameters.get("timeout") or default)
    except ValueError:
        return default
    return min(max(seconds, 0.0), 3600.0)


def convert(payload: bytes, given: PayloadType, wanted: PayloadType) -> bytes:
    """A payload converted from the caller's type to the topic's: a text, a number, a list, or nothing.

    Returned unchanged if that can't be done; the check against the topic's type then reports it.
    """
    if given.zenoh_encoding == wanted.zenoh_encoding:
        return payload
    try:
        value = decode_value(payload, given)
        converted = payload if isinstance(value, bytes | Empty) else encode_as(value, wanted)
    except InvalidPayload:
        return payload
    return payload if converted is None else converted


def _reply(query: zenoh.Query, finished: events.CommandFinished) -> None:
    if finished.status is CallStatus.FAILED:
        _reply_failure(query, finished.reason, finished.detail)
        return
    encoding = finished.type.zenoh_encoding if finished.type is not None else ""
    with query:
        query.reply(str(query.key_expr), finished.payload, encoding=encoding, attachment=finished.status.value)


def _reply_failure(query: zenoh.Query, reason: str, detail: str) -> None:
    """Reply that a call was not done, or that this is not known; `reason` is one of `REASONS`."""
    assert reason in REASONS
    failure = {"reason": reason, "detail": public_text(detail)}
    with query:
        query.reply_err(msgspec.json.encode(failure), encoding="application/json")


@contextmanager
def serve_metrics(edge: Edge, listen: str) -> Iterator[None]:
    """Serve metrics and health at `listen` (HOST:PORT); nothing if it is empty.

    Raises `ConfigurationError`. The server is imported only if it is used.
    """
    if not listen:
        yield
        return
    from mesh.telemetry.serving import open_server

    with open_server(listen, edge.families, lambda: Health.of(edge.parts())):
        yield


def run_edge(edge: Edge, settings: Settings, endpoints: Endpoints) -> None:
    """Serve a board until Ctrl-C or SIGTERM. On the main thread of a process of its own.

    Waits for the files that the settings name, if they say so. Raises `NetworkUnavailable`.
    """
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(INTERRUPTED))
    for delay in file_delays(settings):
        time.sleep(delay)
    with SessionOpening(endpoints).run() as session:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda number, frame: edge.stop())
        board = edge.options
        protocol = "any protocol" if board.protocol == AUTO else board.protocol
        speed = f"{board.baud} baud" if board.baud else "any baud rate"
        words = f"edge of {board.agent}: {board.name} on {board.port}, {protocol} at {speed}, Zenoh id {session.zid()}"
        set_process_source(LogSource("edge", parse_address(board.agent)))
        announce(log, "edge-started", words, device=board.name)
        socket = f"device-{board.name}-of-{board.agent}"
        with (
            answer_log_queries(session, str(DeviceTopicKey(board.agent, board.name, LOG)), "edge"),
            listening(stop_folder(settings), socket, edge.stop_from_thread),
        ):
            edge.run(session)
