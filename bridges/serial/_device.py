"""A device from the view of its agent's code: call it over the mesh, and listen to what it publishes."""

from __future__ import annotations

import asyncio
import time
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec
import zenoh

from bridges.devices import ABOUT, DeviceAbout, said_by
from bridges.serial.dialect import COMMAND_LIMITS, REASONS, CallFailed, CallStatus, Flow, call_failed
from mesh.errors import RemoteError
from mesh.network import Pump
from mesh.network.presence import present_keys
from schemas import DeviceTopicKey, LiabilityTopicKey, payload_type
from schemas.decoding import InvalidData, decode_json
from schemas.errors import InvalidKey, InvalidPayload
from schemas.keys import PRESENT, any_topic_selector, parse_agent_key
from schemas.payloads import Empty, encode_value, plain_value

if TYPE_CHECKING:
    from mesh.agent.agent import Agent
    from mesh.agent.handlers import Job

GRACE: Final = 5.0
"""Seconds beyond the timeout of a call in which its edge agent has to report how it ended."""


class _Failure(msgspec.Struct, frozen=True):
    """An error reply of the edge agent."""

    reason: str
    detail: str


@dataclass(frozen=True)
class CallReply:
    """The outcome of a successful call: the value that the device returned (None for nothing), and its status.

    `DONE`: the device confirmed that it did it, once. `READ`: a rosserial board read on after the message, but it skips
    a message that was damaged on the line silently.
    """

    value: Any
    status: CallStatus


class DeviceMessages(Pump[Any]):
    """What a device says on a topic, decoded: `async with device.listen("/x") as messages`, then `async for`."""

    async def __anext__(self) -> Any:
        return (await super().__anext__())[0]  # a pump would leave out None, which stands for std_msgs/Empty


class Device:
    """The device `name` of a running agent, on whatever machine its `aira edge` runs.

    A call waits at most `patience` seconds for the device to be present and to finish. `in_doubt` says what happens
    when the device was restarted during a call, so that it is not known whether it did it: `fail`, or `again` to repeat
    calls that do no harm when done twice.
    """

    def __init__(
        self,
        agent: Agent,
        name: str = "board",
        *,
        patience: float = COMMAND_LIMITS.patience,
        in_doubt: Literal["fail", "again"] = "fail",
    ) -> None:
        self._agent = agent
        self.name = name
        self._patience = patience
        self._in_doubt = in_doubt

    async def call(self, topic: str, message: object = Empty(), *, job: Job | None = None) -> CallReply:
        """Call a topic of the device, and return when it is done.

        With a `job`, its recording has the message, and what the device answered on `{topic}/answer`. `message` is
        anything that `Job.publish` accepts. Takes at most `patience` and a few seconds. Raises `CallFailed`. Cancelling
        stops the waiting, not the device.
        """
        payload, kind = encode_value(message)
        key = self._key(topic, job)
        deadline = time.monotonic() + self._patience
        while True:
            await self._wait_until_present(topic, deadline)
            try:
                seconds = max(0.0, deadline - time.monotonic())
                return await self._query(topic, key, payload, kind.zenoh_encoding, seconds)
            except CallFailed as error:
                if error.code != "call-in-doubt" or self._in_doubt == "fail" or time.monotonic() >= deadline:
                    raise

    async def is_present(self) -> bool:
        return bool(await asyncio.to_thread(present_keys, self._session, self._key(PRESENT), timeout=GRACE))

    def listen(self, topic: str) -> DeviceMessages:
        """What the device publishes on a topic, in jobs and outside: `async with device.listen("/x") as messages`.

        Messages are decoded, a text to a `str`; those that are not of their type are left out. A handler that wants
        those of its own job only uses `job.listen`.
        """
        return DeviceMessages(
            self._session, any_topic_selector(self._agent.address, topic), partial(self._heard, topic)
        )

    async def next(self, topic: str) -> Any:
        """The next message that the device publishes on a topic. Raises `RemoteError` after `patience` seconds."""
        try:
            async with asyncio.timeout(self._patience), self.listen(topic) as messages:
                return await anext(messages)
        except TimeoutError:
            why = f"the device {self.name} published nothing on {topic} within {self._patience:g} s"
            raise RemoteError(
                why, hint="is it plugged in, and its `aira edge` running?", code="device-silent"
            ) from None

    def _heard(self, topic: str, sample: zenoh.Sample) -> tuple[Any] | None:
        """The message in a sample, in a tuple; None if it is not one that the device said on the topic."""
        try:
            key = parse_agent_key(str(sample.key_expr))
            if isinstance(key, DeviceTopicKey):
                is_said = (key.device, key.topic) == (self.name, topic)
            else:
                by = sample.attachment.to_bytes() if sample.attachment is not None else b""
                is_said = (
                    isinstance(key, LiabilityTopicKey)
                    and key.topic == topic
                    and by.split(b"\n", 1)[0] == said_by(self.name)
                )
            kind = payload_type(str(sample.encoding))
            return (plain_value(sample.payload.to_bytes(), kind),) if is_said else None
        except (InvalidKey, InvalidPayload):
            return None

    @property
    def _session(self) -> zenoh.Session:
        return self._agent.parts.network.session

    def _key(self, topic: str, job: Job | None = None) -> str:
        if job is None:
            return str(DeviceTopicKey(self._agent.address, self.name, topic))
        return str(LiabilityTopicKey(self._agent.address, job.liability.address, topic))

    async def _wait_until_present(self, topic: str, deadline: float) -> None:
        while not await self.is_present():
            if time.monotonic() >= deadline:
                raise call_failed(topic, "absent", f"the device {self.name} was absent for {self._patience:g} s")
            await asyncio.sleep(0.25)  # a device that is plugged in should be found at once, and asking costs little

    async def _query(self, topic: str, key: str, payload: bytes, encoding: str, seconds: float) -> CallReply:
        token = zenoh.CancellationToken()
        get = partial(self._session.get, payload=payload, encoding=encoding, timeout=seconds + GRACE)
        selector = f"{key}?timeout={seconds:.3f};device={self.name}"
        try:
            reply = await asyncio.to_thread(lambda: next(iter(get(selector, cancellation_token=token)), None))
        finally:
            token.cancel()  # type: ignore[no-untyped-call]
        if reply is None:
            await asyncio.to_thread(self._check_topic, topic)
            raise call_failed(topic, "doubt", "the device's edge agent stopped before it reported the outcome")
        if reply.ok is None:
            raise _error_of(topic, b"" if reply.err is None else reply.err.payload.to_bytes())
        status = reply.ok.attachment
        is_read = status is not None and status.to_string() == CallStatus.READ.value
        value = plain_value(reply.ok.payload.to_bytes(), payload_type(str(reply.ok.encoding)))
        return CallReply(value if value != b"" else None, CallStatus.READ if is_read else CallStatus.DONE)

    def _check_topic(self, topic: str) -> None:
        """Raise `CallFailed` if the device says that it has no such topic to call."""
        reply = next(iter(self._session.get(self._key(ABOUT), timeout=GRACE)), None)
        if reply is not None and reply.ok is not None:
            topics = decode_json(reply.ok.payload.to_bytes(), DeviceAbout).topics
            callable_ = [one.name for one in topics if one.flow in (Flow.SUBSCRIBES.value, Flow.SERVES.value)]
            if topic not in callable_:
                detail = f"no such topic to call; {self.name} has {', '.join(callable_) or 'none'}"
                raise CallFailed(topic, "no-such-topic", detail, code="no-such-topic")


def _error_of(topic: str, payload: bytes) -> CallFailed:
    with suppress(InvalidData):
        if (failure := decode_json(payload, _Failure)).reason in REASONS:
            return call_failed(topic, failure.reason, failure.detail)
    return call_failed(topic, "doubt", "no answer came in time")
