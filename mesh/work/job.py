"""The job, as its handlers see it."""

from __future__ import annotations

import time
import weakref
from typing import TYPE_CHECKING, Any

from mesh.errors import AiraError, ClosedError
from mesh.network import sending
from mesh.recording import encode_described
from mesh.work.listening import JobMessages
from schemas.agent_keys import LiabilityTopicKey, topic_chunks
from schemas.definitions import SentDefinitions
from schemas.payloads import PayloadType, payload_type

if TYPE_CHECKING:
    import zenoh

    from mesh.recording import Played
    from schemas import Liability


class JobFailed(AiraError, code="job-failed"):
    """Raise it in a handler to end the job without success, which refunds the promisee. The text says why."""


class HandlerCancelled(AiraError, code="handler-cancelled"):
    """A handler ended because something that it waited for was cancelled, so it has not done its work."""


class Job:
    """The work for one liability, as its handlers see it."""

    def __init__(self, session: zenoh.Session, agent: str, liability: Liability, *, position: int = 0) -> None:
        self._session = session
        self._agent = agent
        self._types: dict[tuple[str, str], PayloadType] = {}
        self._definitions = SentDefinitions()
        self._subscriber: Any = None
        self._listening: tuple[weakref.ref[JobMessages], ...] = ()
        self.liability = liability
        """The contract that this job is for."""
        self.topics: frozenset[str] = frozenset()
        """The topics of its objective."""
        self.position = position
        """How many of the objective's messages have been handled."""
        self.playing: Played | None = None
        """The message that is being handled: its topic, times and type."""

    def __repr__(self) -> str:
        return f"Job({self.liability.address}, position={self.position}, topics={sorted(self.topics)})"

    def publish(self, topic: str, message: object) -> None:
        """Publish on a topic of the job, as a device does. The message becomes part of the recording.

        `message` is a number, a bool, a str, bytes, None, a list, a dict, a msgspec Struct, a dataclass, `Empty`,
        `String`, a number or array of numpy, or a `Payload`. Raises `InvalidPayload` for anything else (also for NaN in
        a dict or Struct, which become JSON), and `ClosedError` before the job runs and after it has ended.
        """
        self._check_running()
        payload, kind = encode_described(message)
        key = str(LiabilityTopicKey(self._agent, self.liability.address, topic))
        attachment = None
        if payload_type(kind.zenoh_encoding) != kind:  # the name alone does not say what it is
            self._types[topic, kind.zenoh_encoding] = kind
            attachment = self._definitions.attachment(b"", key, kind, time.monotonic()) or None
        self._put(key, payload, kind, attachment)

    def listen(self, topic: str) -> JobMessages:
        """What is published on a topic of the job from now on: `async for message in job.listen("/measurements")`.

        That is what a device says, decoded, and what `publish` puts there. The iteration ends with the job. Raises
        `InvalidKey` for an invalid topic, and `ClosedError` before the job runs and after it has ended.
        """
        self._check_running()
        messages = JobMessages(topic_chunks(topic))
        self._listening = (*(one for one in self._listening if one() is not None), weakref.ref(messages))
        return messages

    def _deliver(self, topic: str, payload: bytes, kind: PayloadType) -> None:
        """Pass a received message on to those who listen to its topic. On any thread."""
        for reference in self._listening:
            if (messages := reference()) is not None and messages.topic == topic:
                messages.deliver(payload, kind)

    def _end_listening(self) -> None:
        for reference in self._listening:
            if (messages := reference()) is not None:
                messages.end()

    def _check_running(self) -> None:
        if self._subscriber is None:
            raise ClosedError(f"the job {self.liability.address} is not running")

    def _put(self, key: str, payload: bytes, kind: PayloadType, attachment: bytes | None = None) -> None:
        sending.put(self._session, key, payload, encoding=kind.zenoh_encoding, attachment=attachment)
