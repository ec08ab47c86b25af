"""The edge agent: serves a board's topics as keys of its agent.

Outside a job a topic is `aira/agent/{address}/device/{device}/{topic}`; messages of a job use the liability's topics
and are recorded. A put is a command without a reply; a query is a call, whose reply reports how it ended. While the
board answers, its liveliness token is on the device's topic `/present`.

If several devices of an agent share a topic's name, a call reaches the one that its parameter `device` names, a command
in a job all of them. Edge agents mark what they put, so that others don't take it for a command.
"""

from __future__ import annotations

import logging
import time
from functools import partial
from typing import TYPE_CHECKING, Any

import zenoh

from bridges.devices import ABOUT, CONNECTION, PRESENT, PUT_BY_EDGE, JobTracker, is_put_by_edge, said_by
from bridges.serial import dialect as events
from bridges.serial.calls import ANSWER, PATIENCE, PendingCalls, convert, is_for_device, reply_about
from bridges.serial.dialect import BoardTopic, Command, Flow
from bridges.serial.errors import BoardBusy, InvalidBoardMessage
from bridges.serial.line import SerialLine
from bridges.serial.metrics import EdgeCounters
from mesh.errors import InvalidKey
from mesh.log_context import liability_context, log_event
from mesh.network import sending
from schemas.agent_keys import DeviceTopicKey, LiabilityTopicKey, parse_agent_key, topic_chunks
from schemas.payloads import EMPTY, STRING, String, payload_type
from schemas.selectors import event_selector, topic_selector

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from bridges.serial.dialect import DeviceInfo, Dialect, LineEvent
    from bridges.serial.line import PortName
    from schemas.payloads import PayloadType

log = logging.getLogger(__name__)


class Edge:
    """A board in the mesh, on an open session, as the device `name` of the agent with the address `agent`.

    A command waits at most `patience` seconds for a board that is absent or busy; `rename` maps the board's topics to
    their names in the mesh. `run` blocks its thread and needs no event loop. Raises `InvalidKey` for an invalid name.
    """

    def __init__(
        self,
        session: zenoh.Session,
        port: PortName,
        dialect: Dialect,
        *,
        agent: str,
        name: str,
        patience: float = PATIENCE,
        rename: Callable[[str], str] = str,
    ) -> None:
        self._session = session
        self._agent = agent
        self._name = name
        self._rename = rename
        self._patience = patience
        self._jobs = JobTracker()
        self._line = SerialLine(port, dialect, on_event=self._on_event)
        self.counters = EdgeCounters(self._line)
        self._calls = PendingCalls(self.counters)
        self._declared: dict[str, list[Any]] = {}
        self._token: Any = None
        self._name_of: dict[BoardTopic, str] = {}
        self._commandable: dict[str, BoardTopic] = {}
        self._key(PRESENT)

    def run(self) -> None:
        """Serve until `stop`."""
        subscriber: Any = self._session.declare_subscriber(event_selector(self._agent), self._on_job_event)
        about: Any = self._session.declare_queryable(
            self._key(ABOUT), lambda query: self._line.call_soon(partial(self._reply_about, query))
        )
        try:
            self._line.run()
        finally:
            self._calls.drop()
            if not self._session.is_closed():
                for declared in (subscriber, about, *(each for several in self._declared.values() for each in several)):
                    declared.undeclare()
                self._withdraw_token()

    def stop(self) -> None:
        """End `run`; from any thread, and from a signal handler."""
        self._line.stop()

    def _on_event(self, event: LineEvent) -> None:
        with liability_context(self._jobs.current):
            match event:
                case events.BoardReady(info):
                    self._board_ready(info)
                case events.BoardLost(reason):
                    self.counters.count_loss()
                    log.warning("the board is absent: %s", reason, extra=log_event("board-lost", reason=reason))
                    self._record_connection(f"absent: {reason}")
                    self._withdraw_token()
                case events.MessageReceived(topic, payload):
                    self._publish(topic, payload)
                case events.CommandFinished():
                    self._record_answer(event)
                    self._calls.finish(event)
                case events.BoardLogged(level, text):
                    log.log(level, "the board says: %s", text, extra=log_event("board-logged"))

    def _board_ready(self, info: DeviceInfo) -> None:
        """Declare the board's topics in the mesh, and its presence."""
        self._name_of = dict(self._valid_names(info))
        accepting = [topic for topic in self._name_of if topic.flow in (Flow.SUBSCRIBES, Flow.SERVES)]
        self._commandable = {self._name_of[topic]: topic for topic in reversed(accepting)}
        for topic in accepting:
            if self._commandable[name := self._name_of[topic]] != topic:
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
        topics = ", ".join(self._name_of.values()) or "no topics"
        ready = log_event("board-ready", name=info.name, version=info.version, topics=topics)
        title = " ".join(filter(None, ("the board", info.name, info.version)))
        log.info("%s is present: %s", title, topics, extra=ready)

    def _valid_names(self, info: DeviceInfo) -> Iterator[tuple[BoardTopic, str]]:
        """The board's topics with their names in the mesh; those without a valid one are left out."""
        for topic in info.topics:
            try:
                yield topic, topic_chunks(self._rename(topic.name))
            except InvalidKey as error:
                rejected = log_event("topic-rejected", topic=topic.name)
                log.warning("topic %s of the board is not used: %s", topic.name, error, extra=rejected)

    def _declare(self, name: str) -> list[Any]:
        """Subscribe to commands and calls on a topic, in jobs and outside."""
        keys = (self._key(name), topic_selector(self._agent, topic=name))
        return [
            *(self._session.declare_subscriber(key, self._on_command) for key in keys),
            *(self._session.declare_queryable(key, self._on_call) for key in keys),
        ]

    def _withdraw_token(self) -> None:
        token, self._token = self._token, None
        if token is not None:
            token.undeclare()

    # Zenoh's callbacks run on its threads, and pass their work to the line's thread.

    def _on_job_event(self, sample: zenoh.Sample) -> None:
        self._line.call_soon(partial(self._jobs.handle_event, str(sample.key_expr)))

    def _on_command(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT and not is_put_by_edge(sample.attachment):
            given = payload_type(str(sample.encoding))
            self._line.call_soon(partial(self._command, str(sample.key_expr), sample.payload.to_bytes(), given))

    def _on_call(self, query: zenoh.Query) -> None:
        self._line.call_soon(partial(self._call, query))

    def _command(self, key: str, payload: bytes, given: PayloadType) -> None:
        topic, job = self._topic_of(key)
        if topic is None:
            return
        now = time.monotonic()
        payload = convert(payload, given, topic.type)
        try:
            self._line.dialect.submit(Command(topic.name, payload, now + self._patience), now)
        except (InvalidBoardMessage, BoardBusy) as error:
            with liability_context(job):
                log.warning("%s", error, extra=log_event("command-rejected", topic=topic.name, code=error.code))

    def _call(self, query: zenoh.Query) -> None:
        """Submit a call; it is also put into its job's recording."""
        key = str(query.key_expr)
        topic, job = self._topic_of(key) if is_for_device(query, self._name) else (None, "")
        if topic is None:
            query.drop()  # type: ignore[no-untyped-call]
            return
        payload = b"" if query.payload is None else query.payload.to_bytes()
        payload = convert(payload, payload_type(str(query.encoding or "")), topic.type)
        if self._calls.submit(query, topic, payload, self._line.dialect, self._patience) and job:
            self._put(key, payload, topic.type if payload else EMPTY)  # nothing is no JSON

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
        if (name := self._name_of.get(topic)) is None:
            return
        if topic.flow is Flow.REQUESTS:
            self._request(topic, self._key(name), payload)
        else:
            key = self._job_key(job, name) if (job := self._jobs.current) else self._key(name)
            self._put(key, payload, topic.type, attachment=said_by(self._name))

    def _request(self, topic: BoardTopic, key: str, payload: bytes) -> None:
        """Query the mesh for the board, which gets each answer."""

        def on_reply(answer: zenoh.Reply) -> None:
            if answer.ok is not None:
                data = answer.ok.payload.to_bytes()
                self._line.call_soon(lambda: self._line.dialect.respond(topic, data, time.monotonic()))

        self._session.get(key, on_reply, payload=payload)

    def _record_connection(self, text: str) -> None:
        """Add a loss or return of the device to the recording of the current job, if there is one."""
        if job := self._jobs.current:
            self._put(self._job_key(job, f"{CONNECTION}/{self._name}"), String(text).encode(), STRING)

    def _record_answer(self, finished: events.CommandFinished) -> None:
        """Add what the board answered to a call to the recording of the call's job; nothing and null are left out."""
        if finished.type is None or finished.payload in (b"", b"null"):
            return
        if key := self._calls.key_of(finished.command):
            called = parse_agent_key(key)
            if isinstance(called, LiabilityTopicKey):
                self._put(self._job_key(called.liability, called.topic + ANSWER), finished.payload, finished.type)

    def _reply_about(self, query: zenoh.Query) -> None:
        reply_about(query, self._line.dialect, self._name_of, port=str(self._line.name), job=self._jobs.current)

    def _key(self, topic: str) -> str:
        """The key of a topic outside any job. Raises `InvalidKey`."""
        return str(DeviceTopicKey(self._agent, self._name, topic))

    def _job_key(self, liability: str, topic: str) -> str:
        """The key of a topic of the job at `liability` (address), which all devices of the agent share."""
        return str(LiabilityTopicKey(self._agent, liability, topic))

    def _put(self, key: str, payload: bytes, kind: PayloadType, *, attachment: bytes = PUT_BY_EDGE) -> None:
        sending.put(self._session, key, payload, encoding=kind.zenoh_encoding, attachment=attachment)
