"""A device from the view of its agent's code: call it over the mesh, and listen to what it publishes."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec
import zenoh

from bridges.serial.calls import PATIENCE, PRESENT
from bridges.serial.dialect import CallStatus
from bridges.serial.errors import CALL_ERRORS, CallFailed, CallInDoubt, CallNotDone, DeviceSilent
from mesh.network import Pump
from mesh.retry import Backoff, RetryPolicy
from schemas import DeviceTopicKey, LiabilityTopicKey, payload_type
from schemas.errors import InvalidPayload
from schemas.payloads import Empty, decode_value, encode_value

if TYPE_CHECKING:
    from mesh.agent import Agent
    from mesh.work.job import Job

PRESENCE_POLL: Final = RetryPolicy(initial=0.25, factor=1.0, ceiling=0.25, jitter=0.0)
"""A device that is plugged in should be found at once, and asking for its token costs little: so no backoff."""
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
        patience: float = PATIENCE,
        in_doubt: Literal["fail", "again"] = "fail",
        presence_poll: RetryPolicy = PRESENCE_POLL,
    ) -> None:
        self._agent = agent
        self.name = name
        self._patience = patience
        self._in_doubt = in_doubt
        self._presence_poll = presence_poll

    async def call(self, topic: str, message: object = Empty(), *, job: Job | None = None) -> CallReply:
        """Call a topic of the device, and return when it is done. With a `job`, its recording has message and answer.

        `message` is anything that `Job.publish` accepts. Takes at most `patience` and a few seconds. Raises
        `CallNotDone` (it certainly was not done), `CallRefused` (the device refused it, or can't do it) and
        `CallInDoubt` (it may have been done). Cancelling stops the waiting, not the device.
        """
        payload, kind = encode_value(message)
        key = self._key(topic, job)
        deadline = time.monotonic() + self._patience
        while True:
            await self._wait_until_present(topic, deadline)
            try:
                seconds = max(0.0, deadline - time.monotonic())
                return await self._query(topic, key, payload, kind.zenoh_encoding, seconds)
            except CallInDoubt:
                if self._in_doubt == "fail" or time.monotonic() >= deadline:
                    raise

    async def is_present(self) -> bool:
        """Whether the device is plugged in and answers."""
        return await asyncio.to_thread(self._has_token)

    def listen(self, topic: str) -> Pump[Any]:
        """What the device publishes on a topic outside any job: `async with device.listen("/x") as messages`.

        Messages are decoded; those that are not of their type are left out.
        """
        return Pump(self._session, self._key(topic), _decode)

    async def next(self, topic: str) -> Any:
        """The next message that the device publishes on a topic. Raises `DeviceSilent` after `patience` seconds."""
        try:
            async with asyncio.timeout(self._patience), self.listen(topic) as messages:
                return await anext(messages)
        except TimeoutError:
            raise DeviceSilent(self.name, topic, self._patience) from None

    @property
    def _session(self) -> zenoh.Session:
        return self._agent.parts.network.session

    def _key(self, topic: str, job: Job | None = None) -> str:
        if job is None:
            return str(DeviceTopicKey(self._agent.address, self.name, topic))
        return str(LiabilityTopicKey(self._agent.address, job.liability.address, topic))

    def _has_token(self) -> bool:
        replies = self._session.liveliness().get(self._key(PRESENT), timeout=GRACE)
        return any(reply.ok is not None for reply in replies)

    async def _wait_until_present(self, topic: str, deadline: float) -> None:
        backoff = Backoff(self._presence_poll)
        while not await self.is_present():
            if time.monotonic() >= deadline or not await backoff.wait():
                raise CallNotDone(topic, "absent", f"the device {self.name} was absent for {self._patience:g} s")

    async def _query(self, topic: str, key: str, payload: bytes, encoding: str, seconds: float) -> CallReply:
        token = zenoh.CancellationToken()
        get = partial(self._session.get, payload=payload, encoding=encoding, timeout=seconds + GRACE)
        selector = f"{key}?timeout={seconds:.3f};device={self.name}"
        try:
            reply = await asyncio.to_thread(lambda: next(iter(get(selector, cancellation_token=token)), None))
        finally:
            token.cancel()  # type: ignore[no-untyped-call]
        if reply is None:
            raise CallInDoubt(topic, "doubt", "the device's edge agent stopped before it reported the outcome")
        if reply.ok is None:
            raise _error_of(topic, b"" if reply.err is None else reply.err.payload.to_bytes())
        status = reply.ok.attachment
        is_read = status is not None and status.to_string() == CallStatus.READ.value
        value = decode_value(reply.ok.payload.to_bytes(), payload_type(str(reply.ok.encoding)))
        return CallReply(value if value != b"" else None, CallStatus.READ if is_read else CallStatus.DONE)


def _decode(sample: zenoh.Sample) -> Any:
    try:
        return decode_value(sample.payload.to_bytes(), payload_type(str(sample.encoding)))
    except InvalidPayload:
        return None


def _error_of(topic: str, payload: bytes) -> CallFailed:
    try:
        failure = msgspec.json.decode(payload, type=_Failure)
        return CALL_ERRORS[failure.reason](topic, failure.reason, failure.detail)
    except (msgspec.DecodeError, UnicodeDecodeError, KeyError):
        return CallInDoubt(topic, "doubt", "no answer came in time")
