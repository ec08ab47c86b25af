"""What is said on keys of the mesh now, recorded."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any

import zenoh

import mesh
from mesh.errors import InputError, InvalidKey, RemoteError
from mesh.recording import Recorder, RecordingAbout
from schemas.keys import DeviceTopicKey, LiabilityTopicKey, ObjectiveTopicKey, parse_key
from schemas.payloads import payload_type

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from mesh.recording import RecordingSummary

log = logging.getLogger(__name__)

BEAT = 0.1
"""Seconds between two looks at how much was heard."""


class NothingHeard(RemoteError):
    """Nobody said anything on the keys."""

    code = "nothing-heard"

    def __init__(self, keys: Sequence[str]) -> None:
        super().__init__(
            f"nobody said anything on {', '.join(keys)}", hint="`aira/agent/ADDRESS/device/**` are an agent's devices"
        )
        self.keys = tuple(keys)


def key_expression(text: str) -> str:
    """The same text, if it is a key expression. Raises `InputError`."""
    try:
        return str(zenoh.KeyExpr(text))
    except zenoh.ZError as error:
        raise InputError(f"{text!r} is no key expression: {error}", hint="`*` is any chunk, `**` any chunks") from None


def topic_of(key: str) -> str:
    """The topic that a key of a device or a job has; of any other key, the whole key."""
    try:
        parsed = parse_key(key)
    except InvalidKey:
        return f"/{key}"
    if isinstance(parsed, DeviceTopicKey | LiabilityTopicKey | ObjectiveTopicKey):
        return parsed.topic
    return f"/{key}"


async def hear(
    session: zenoh.Session,
    keys: Sequence[str],
    target: Path,
    *,
    seconds: float | None = None,
    tell: Callable[[float], None] = lambda done: None,
) -> RecordingSummary:
    """Record what is said on `keys` to a new file for so many `seconds`, or until cancelled: then, too, it is finished.

    `tell` is told the seconds so far. Raises `NothingHeard`, and then leaves no file, `RecordingFailed`, and
    `asyncio.CancelledError` never before the file is whole.
    """
    about = RecordingAbout(software=f"aira-mesh {mesh.__version__}")
    recorder = await asyncio.to_thread(Recorder, target, about)

    def heard(sample: zenoh.Sample) -> None:
        try:
            kind = payload_type(str(sample.encoding))
            recorder.record(topic_of(str(sample.key_expr)), sample.payload.to_bytes(), kind)
        except Exception as error:  # nobody stands behind a callback
            log.warning("not recorded from %s: %s", sample.key_expr, error)

    subscribers: list[Any] = []
    try:
        subscribers.extend(session.declare_subscriber(key, heard) for key in keys)
        await _pass_time(seconds, tell)
    finally:
        for subscriber in subscribers:
            subscriber.undeclare()
        summary = await asyncio.to_thread(recorder.close)
        if not summary.messages:
            await asyncio.to_thread(target.unlink)
    if not summary.messages:
        raise NothingHeard(keys)
    return summary


async def _pass_time(seconds: float | None, tell: Callable[[float], None]) -> None:
    loop = asyncio.get_running_loop()
    begin = loop.time()
    while seconds is None or loop.time() - begin < seconds:
        left = BEAT if seconds is None else min(BEAT, seconds - (loop.time() - begin))
        await asyncio.sleep(max(0, left))
        tell(loop.time() - begin)
