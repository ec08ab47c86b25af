"""The edge agent: a board's topics as keys of its agent, and what is put or asked there brought to the board.

Outside a job a topic is `aira/agent/{address}/device/{device}/{topic}`; what belongs to a job goes over the liability's
topics, where it becomes part of the recording. A put is a command of which nobody hears again; a query is a call, and
its reply says how it ended. The board is present as long as its liveliness token is, on the device's topic `/present`.

Of several devices of an agent that have a topic of the same name, a call reaches the one that it names (the parameter
`device`), a command in a job all of them: who wants it otherwise gives their topics other names. What an edge agent
itself says is never a command for another one.
"""

from __future__ import annotations

import logging
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import msgspec
import zenoh

from bridges.serial.converting import converted
from bridges.serial.device_id import ABOUT, PRESENT, DeviceId
from bridges.serial.dialect import BoardTopic, Command, Ended, Ending, Flow, Gone, Logged, Ready, Said
from bridges.serial.errors import BoardBusy, UnfitMessage
from bridges.serial.jobs import Jobs
from bridges.serial.line import Line
from bridges.serial.names import Names
from bridges.serial.replying import is_meant_for, patience_of, refuse, reply
from bridges.serial.tally import Tally
from mesh.errors import InvalidKey
from mesh.telemetry.context import liability_context
from schemas.key_chunks import topic_chunks
from schemas.keys import DeviceTopicKey, LiabilityTopicKey, event_selector, parse_key
from schemas.payloads import STRING, String, payload_type

if TYPE_CHECKING:
    from collections.abc import Iterator

    from bridges.serial.dialect import About, Dialect, Happening
    from bridges.serial.ports import PortName
    from schemas.payloads import PayloadType

log = logging.getLogger(__name__)

PATIENCE: Final = 30.0
"""Seconds for which a command waits for a board that is not there, or busy."""
TOLD: Final = b"told"
"""What is attached to all that an edge agent puts."""


class Edge:
    """A board in the mesh, on an open session: `Edge(session, device, port, dialect, baud=57600).run()`.

    `patience` is for how many seconds a command waits for a board that is not there, or busy; `names` are what the
    board's topics are called in the mesh. `run` serves until `stop` is called from another thread; it takes a thread of
    its own and no event loop. Raises `InvalidKey` for a device that can't be named.
    """

    def __init__(
        self,
        session: zenoh.Session,
        device: DeviceId,
        port: PortName,
        dialect: Dialect,
        *,
        baud: int,
        patience: float = PATIENCE,
        names: Names | None = None,
    ) -> None:
        self._session = session
        self._device = device
        self._names = names or Names()
        self._patience = patience
        self._jobs = Jobs()
        self._line = Line(port, dialect, baud=baud, deliver=self._deliver)
        self.tally = Tally(self._line)
        self._asked: dict[Command, zenoh.Query] = {}
        self._declared: dict[str, list[Any]] = {}
        self._token: Any = None
        self._named: dict[BoardTopic, str] = {}
        self._topics: dict[str, BoardTopic] = {}
        device.key(PRESENT)

    def run(self) -> None:
        """Serve until `stop`."""
        events: Any = self._session.declare_subscriber(event_selector(self._device.agent), self._heard_event)
        about: Any = self._session.declare_queryable(self._device.key(ABOUT), self._asked_about)
        try:
            self._line.run()
        finally:
            for query in self._asked.values():
                query.drop()  # type: ignore[no-untyped-call]
            if not self._session.is_closed():
                for declared in (events, about, *(each for several in self._declared.values() for each in several)):
                    declared.undeclare()
                self._be_absent()

    def stop(self) -> None:
        """End `run`; from any thread, and from a signal's handler."""
        self._line.stop()

    def _deliver(self, happening: Happening) -> None:
        with liability_context(self._jobs.current):
            self._take(happening)

    def _take(self, happening: Happening) -> None:
        match happening:
            case Ready(about):
                self._serve(about)
            case Gone(why):
                self.tally.board_lost()
                log.warning("the board is absent: %s", why)
                self._note(f"absent: {why}")
                self._be_absent()
            case Said(topic, payload):
                self._said(topic, payload)
            case Ended():
                self._ended(happening)
            case Logged(level, text):
                log.log(level, "the board says: %s", text)

    def _serve(self, about: About) -> None:
        """The board is there: have its topics in the mesh, and show that it is present."""
        self._named = dict(self._usable(about))
        heard = [topic for topic in self._named if topic.flow in (Flow.HEARS, Flow.SERVES)]
        self._topics = {self._named[topic]: topic for topic in reversed(heard)}
        for topic in heard:
            if self._topics[self._named[topic]] != topic:
                log.warning(
                    "%s is another topic of the board already, so nothing reaches %s", self._named[topic], topic.name
                )
        for name in self._declared.keys() - self._topics.keys():
            for declared in self._declared.pop(name):
                declared.undeclare()
        for name in self._topics.keys() - self._declared.keys():
            self._declared[name] = self._declare(name)
        self._note("present")
        if self._token is None:
            self._token = self._session.liveliness().declare_token(self._device.key(PRESENT))
        topics = ", ".join(self._named.values()) or "no topics"
        log.info("the board %s %s is present: %s", about.name, about.version, topics)

    def _usable(self, about: About) -> Iterator[tuple[BoardTopic, str]]:
        """The board's topics, each with its name in the mesh."""
        for topic in about.topics:
            try:
                yield topic, topic_chunks(self._names.of(topic.name))
            except InvalidKey as error:
                log.warning("topic %s of the board is not used: %s", topic.name, error)

    def _declare(self, name: str) -> list[Any]:
        """Hear commands and calls on a topic, within jobs and outside."""
        keys = self._device.keys_of(name)
        return [
            *(self._session.declare_subscriber(key, self._heard_command) for key in keys),
            *(self._session.declare_queryable(key, self._heard_call) for key in keys),
        ]

    def _be_absent(self) -> None:
        token, self._token = self._token, None
        if token is not None:
            token.undeclare()

    def _heard_event(self, sample: zenoh.Sample) -> None:
        self._line.do(partial(self._jobs.take_event, str(sample.key_expr)))

    def _heard_command(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT and not _is_told(sample):
            given = payload_type(str(sample.encoding))
            self._line.do(partial(self._command, str(sample.key_expr), sample.payload.to_bytes(), given))

    def _command(self, key: str, payload: bytes, given: PayloadType) -> None:
        topic, job = self._place(key)
        if topic is None:
            return
        now = time.monotonic()
        payload = converted(payload, given, topic.type)
        try:
            self._line.dialect.submit(Command(topic.name, payload, now + self._patience), now)
        except (UnfitMessage, BoardBusy) as error:
            with liability_context(job):
                log.warning("%s", error)

    def _heard_call(self, query: zenoh.Query) -> None:
        self._line.do(partial(self._call, query))

    def _call(self, query: zenoh.Query) -> None:
        """A call, which is answered at its end."""
        key = str(query.key_expr)
        topic, job = self._place(key) if is_meant_for(query, self._device.name) else (None, "")
        if topic is None:
            query.drop()  # type: ignore[no-untyped-call]
            return
        payload = b"" if query.payload is None else query.payload.to_bytes()
        payload = converted(payload, payload_type(str(query.encoding or "")), topic.type)
        now = time.monotonic()
        command = Command(topic.name, payload, now + patience_of(query, self._patience))
        try:
            self._line.dialect.submit(command, now)
        except (UnfitMessage, BoardBusy) as error:
            reason = "full" if isinstance(error, BoardBusy) else "unfit"
            self.tally.ended(reason)
            refuse(query, reason, str(error))
            return
        self._asked[command] = query
        if job:
            self._put(key, payload, topic.type)

    def _place(self, key: str) -> tuple[BoardTopic | None, str]:
        """The topic that a key names, and the job if it is one of a job; which is now the one that goes on."""
        try:
            parsed = parse_key(key)
        except InvalidKey as error:
            log.info("%s", error)
            return None, ""
        if not isinstance(parsed, LiabilityTopicKey | DeviceTopicKey) or parsed.topic not in self._topics:
            return None, ""
        topic = self._topics[parsed.topic]
        if isinstance(parsed, DeviceTopicKey):
            return topic, ""
        self._jobs.begin(parsed.liability)
        return topic, parsed.liability

    def _said(self, topic: BoardTopic, payload: bytes) -> None:
        if (name := self._named.get(topic)) is None:
            return
        if topic.flow is Flow.ASKS:
            self._ask(topic, self._device.key(name), payload)
            return
        job = self._jobs.current
        key = self._device.key_of_job(job, name) if job else self._device.key(name)
        self._put(key, payload, topic.type)

    def _ask(self, topic: BoardTopic, key: str, payload: bytes) -> None:
        """The board asks; what is answered in the mesh reaches it."""

        def answered(said: zenoh.Reply) -> None:
            if said.ok is not None:
                answer = said.ok.payload.to_bytes()
                self._line.do(lambda: self._line.dialect.answer(topic, answer, time.monotonic()))

        self._session.get(key, answered, payload=payload)

    def _note(self, text: str) -> None:
        """Have the recording of the job that goes on, if there is one, say what became of the device."""
        if self._jobs.current:
            self._put(self._device.cable(self._jobs.current), String(text).encode(), STRING)

    def _ended(self, ended: Ended) -> None:
        query = self._asked.pop(ended.command, None)
        self.tally.ended(ended.reason or ended.ending.value)
        if ended.ending is Ending.FAILED:
            log.warning("%s: %s (%s)", ended.command.topic, ended.detail, ended.reason)
        if query is not None:
            reply(query, ended)

    def _asked_about(self, query: zenoh.Query) -> None:
        self._line.do(partial(self._tell_about, query))

    def _tell_about(self, query: zenoh.Query) -> None:
        about, dialect = self._line.dialect.about, self._line.dialect
        facts = {
            "name": about.name if about is not None else "",
            "version": about.version if about is not None else "",
            "present": about is not None,
            "port": str(self._line.name),
            "job": self._jobs.current,
            "topics": [
                {"name": name, "flow": topic.flow.value, "type": topic.type.schema_name or topic.type.encoding}
                for topic, name in self._named.items()
            ],
            "counters": vars(dialect.counters),
        }
        with query:
            query.reply(str(query.key_expr), msgspec.json.encode(facts), encoding="application/json")

    def _put(self, key: str, payload: bytes, kind: PayloadType) -> None:
        drop = zenoh.CongestionControl.DROP
        self._session.put(key, payload, encoding=kind.zenoh_encoding, attachment=TOLD, congestion_control=drop)


def _is_told(sample: zenoh.Sample) -> bool:
    """Whether an edge agent tells what a device has said, or was called to do: that is no command."""
    return sample.attachment is not None and sample.attachment.to_bytes() == TOLD
