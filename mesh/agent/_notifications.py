"""Notifications: tells the owner of a robot what happens to it, at the targets that `notify` names.

A target is a URL, which gets each event as a POST, or the path of a program, which gets it on its standard input and is
done when it ends with 0. The event is a CloudEvent (1.0) in JSON. With a secret (`notify_secret_file`) a POST is signed
as Standard Webhooks are: `webhook-signature` has the HMAC-SHA256 of `{webhook-id}.{webhook-timestamp}.{body}`.

Nothing waits for a target: events are queued, and each target has a task of its own, which repeats a delivery with
backoff. An event has the same `id` whenever it is delivered. What a target has not got when the agent ends is lost.
"""

from __future__ import annotations

import asyncio
import base64
import binascii
import hashlib
import hmac
import logging
import os
import secrets
import signal
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple
from urllib.parse import urlsplit

import msgspec

from mesh.base.background import Background, call_in_loop
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import log_event
from mesh.base.retry import Backoff, RetryPolicy
from mesh.errors import ConfigurationError
from mesh.market.transactions import least_cost
from mesh.network import NetworkChange
from mesh.network.presence import PresenceWatch
from schemas.decoding import InvalidData, first_line
from schemas.keys import PRESENT, DeviceTopicKey, device_selector, parse_agent_key
from schemas.records import NotifyTarget, RobotEvent

if TYPE_CHECKING:
    from collections.abc import Coroutine, Iterator, Mapping
    from contextlib import AsyncExitStack

    from mesh.agent.components import AgentComponents
    from mesh.settings.groups import NotificationSettings, OwnerEvent


log = logging.getLogger(__name__)

RECENT: Final = 20
"""Events that are remembered for the owner, who may look at them later."""


class DeliveryLimits(NamedTuple):
    """What one target of notifications may use."""

    waiting: int = 1_000
    """Events that wait for it; more push out the oldest."""
    retry: RetryPolicy = RetryPolicy(initial=1.0, ceiling=600.0, attempts=20)
    """Deliveries of one event, within two hours."""
    post: float = 10.0
    """Seconds for a POST."""
    program: float = 60.0
    """Seconds for a program, which is killed then."""
    ending: float = 3.0
    """Seconds for which an agent that ends waits until the target has what waits."""


DELIVERY_LIMITS: Final = DeliveryLimits()
PARTS: Final = 64
"""Parts that may be unreachable at the same time: without a roster at the router, strangers may announce devices."""
ROUTER: Final = "router"
SECRET_PREFIX: Final = b"whsec_"
"""How the secrets of Standard Webhooks begin: base64 follows."""


class Undelivered(Exception):
    """A target did not take an event; the text says why, without the target's address."""


@dataclass(frozen=True, slots=True)
class Notification:
    """An event that is delivered: its id, and its JSON."""

    id: str
    body: bytes


class Webhook:
    """A URL that gets events by POST. Its path may be a secret, so only its host is ever shown."""

    def __init__(self, url: str, secret: bytes) -> None:
        self._url = url
        self._secret = secret

    def __str__(self) -> str:
        return urlsplit(self._url).hostname or "?"

    async def deliver(self, event: Notification) -> None:
        """Raises `Undelivered` unless the answer is 2xx. Redirects are not followed."""
        from aiohttp import ClientError, ClientSession, ClientTimeout

        headers = {"Content-Type": "application/cloudevents+json"} | self._signature(event, int(time.time()))
        try:
            async with (
                ClientSession(timeout=ClientTimeout(total=DELIVERY_LIMITS.post)) as session,
                session.post(self._url, data=event.body, headers=headers, allow_redirects=False) as answer,
            ):
                if not 200 <= answer.status < 300:
                    raise Undelivered(f"it answered {answer.status}")
        except TimeoutError:
            raise Undelivered(f"it did not answer within {DELIVERY_LIMITS.post:g} s") from None
        except (ClientError, OSError, ValueError) as error:
            raise Undelivered(type(error).__name__) from None

    def _signature(self, event: Notification, now: int) -> dict[str, str]:
        if not self._secret:
            return {}
        signed = hmac.digest(self._secret, f"{event.id}.{now}.".encode() + event.body, hashlib.sha256)
        signature = f"v1,{base64.b64encode(signed).decode()}"
        return {"webhook-id": event.id, "webhook-timestamp": str(now), "webhook-signature": signature}


class Script:
    """A program that gets each event on its standard input."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __str__(self) -> str:
        return self._path.name

    async def deliver(self, event: Notification) -> None:
        """Raises `Undelivered` unless the program ends with 0 in time."""
        nowhere = asyncio.subprocess.DEVNULL
        try:
            program = await asyncio.create_subprocess_exec(
                self._path, stdin=asyncio.subprocess.PIPE, stdout=nowhere, stderr=nowhere, start_new_session=True
            )
        except OSError as error:
            raise Undelivered(f"it can't be started: {error.strerror}") from None
        try:
            async with asyncio.timeout(DELIVERY_LIMITS.program):
                await program.communicate(event.body + b"\n")
        except TimeoutError:
            raise Undelivered(f"it did not end within {DELIVERY_LIMITS.program:g} s") from None
        finally:
            with suppress(ProcessLookupError):  # what it has started ends with it
                os.killpg(program.pid, signal.SIGKILL)
            await program.wait()
        if program.returncode:
            raise Undelivered(f"it ended with {program.returncode}")


class Notifier(Lifecycle):
    """Tells the owner of the agent `address` what `notify_events` names: `async with Notifier(…) as notifier`.

    Raises `ConfigurationError` for a target or a secret that can't be used.
    """

    title = "notifier"

    def __init__(
        self, settings: NotificationSettings, address: str, *, retry: RetryPolicy = DELIVERY_LIMITS.retry
    ) -> None:
        secret = _secret(settings.notify_secret_file) if settings.notify_secret_file else b""
        self.wanted: Final = frozenset(settings.notify_events)
        """The events that are remembered, and delivered."""
        self.recent: Final = deque[RobotEvent]()
        """The latest events, oldest first, also if there are no targets."""
        self._source = f"/aira/agent/{address}"
        self._retry = retry
        self._outboxes = [_Outbox(_target(text, secret)) for text in settings.notify]

    async def _open(self, stack: AsyncExitStack) -> None:
        tasks = await stack.enter_async_context(Background())
        for outbox in self._outboxes:
            tasks.start(outbox.run(self._retry), f"notify {outbox.target}")
        stack.push_async_callback(self._drain)

    def targets(self) -> tuple[NotifyTarget, ...]:
        """Who is told, without what may be secret."""
        return tuple(NotifyTarget(str(outbox.target), len(outbox)) for outbox in self._outboxes)

    def notify(self, event: OwnerEvent, data: Mapping[str, str], *, about: str = "") -> None:
        """Remember an event, if it is wanted, and tell the targets. Returns at once.

        `about` is what it is about, such as a contract's address; the same event about the same has the same id.
        """
        if event not in self.wanted:
            return
        at = datetime.now(UTC)
        detail = next((data[name] for name in ("reason", "part", "balance") if data.get(name)), "")
        self._remember(RobotEvent(event=event, time=at.timestamp(), about=about, detail=detail[:200]))
        now = at.isoformat(timespec="milliseconds").replace("+00:00", "Z")
        identity = f"{event}-{about or secrets.token_hex(8)}"
        envelope = {"specversion": "1.0", "id": identity, "source": self._source, "type": f"aira.{event}", "time": now}
        envelope |= {"subject": about} if about else {}
        body = msgspec.json.encode(envelope | {"datacontenttype": "application/json", "data": data})
        for outbox in self._outboxes:
            outbox.put(Notification(identity, body))

    def _remember(self, event: RobotEvent) -> None:
        """Offers make room first: strangers cause any number of them."""
        self.recent.append(event)
        if len(self.recent) > RECENT:
            self.recent.remove(next((one for one in self.recent if one.event == "job-offered"), self.recent[0]))

    async def _drain(self) -> None:
        with suppress(TimeoutError):
            async with asyncio.timeout(DELIVERY_LIMITS.ending):
                await asyncio.gather(*(outbox.empty.wait() for outbox in self._outboxes))
        for outbox in self._outboxes:
            outbox.report_lost()


class _Outbox:
    """The events that one target has not got yet, oldest first."""

    def __init__(self, target: Webhook | Script) -> None:
        self.target = target
        self.empty = asyncio.Event()
        self.empty.set()
        self._waiting: deque[Notification] = deque()
        self._filled = asyncio.Event()
        self._pushed_out = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, event: Notification) -> None:
        self._waiting.append(event)
        if len(self._waiting) > DELIVERY_LIMITS.waiting:
            self._waiting.popleft()
            self._pushed_out += 1
        self._filled.set()
        self.empty.clear()

    async def run(self, policy: RetryPolicy) -> None:
        while True:
            self._filled.clear()
            while self._waiting:
                event = self._waiting[0]
                await self._deliver(event, Backoff(policy))
                if self._waiting and self._waiting[0] is event:
                    self._waiting.popleft()
            self._report_pushed_out()
            self.empty.set()
            await self._filled.wait()

    async def _deliver(self, event: Notification, backoff: Backoff) -> None:
        while True:
            try:
                return await self.target.deliver(event)
            except Undelivered as error:
                if not backoff.failures:
                    facts = log_event("notification-failed", event_id=event.id, target=str(self.target))
                    text = "%s did not take the notification %s: %s; it is sent again"
                    log.warning(text, self.target, event.id, error, extra=facts)
                if not await backoff.wait():
                    return self._log_lost(1, str(error))

    def _report_pushed_out(self) -> None:
        if self._pushed_out:
            self._log_lost(self._pushed_out, f"more than {DELIVERY_LIMITS.waiting:,} waited")
            self._pushed_out = 0

    def report_lost(self) -> None:
        self._report_pushed_out()
        if self._waiting:
            self._log_lost(len(self._waiting), "the agent ended first")

    def _log_lost(self, count: int, why: str) -> None:
        facts = log_event("notifications-lost", count=count, target=str(self.target))
        log.error("%d notifications for %s are lost: %s", count, self.target, why, extra=facts)


class OwnerWatch:
    """Notices what no job tells: that the agent lost its router or a device (`robot-unreachable`), and `low-on-gas`.

    The robot is unreachable after `grace` seconds without a device, or a router: both may be started again. The
    account's balance is looked at each `gas_interval` seconds, if somebody is told.
    """

    def __init__(
        self, parts: AgentComponents, notifier: Notifier, *, grace: float = 10.0, gas_interval: float = 60.0
    ) -> None:
        self._parts = parts
        self._notifier = notifier
        self._grace = grace
        self._gas_interval = gas_interval if notifier.targets() else 10 * gas_interval  # each look is several questions
        self._timers: dict[str, asyncio.TimerHandle] = {}
        """Of the parts that can't be reached."""

    def tasks(self) -> Iterator[tuple[str, Coroutine[object, object, object]]]:
        if "robot-unreachable" in self._notifier.wanted:
            yield "absent devices", self._watch_devices()
            yield "lost routers", self._watch_router()
        if "low-on-gas" in self._notifier.wanted:
            yield "gas", self._watch_gas()

    async def _watch_devices(self) -> None:
        loop, session = asyncio.get_running_loop(), self._parts.network.session
        selector = device_selector(self._parts.signer.address, topic=PRESENT)

        watch = PresenceWatch(session, selector, partial(call_in_loop, loop, self._device_changed))
        try:
            await asyncio.Event().wait()
        finally:
            watch.end()

    def _device_changed(self, key: str, is_present: bool) -> None:
        parsed = parse_agent_key(key)
        if isinstance(parsed, DeviceTopicKey):
            self._changed(f"device {parsed.device}", is_reachable=is_present)

    async def _watch_router(self) -> None:
        async for change in self._parts.network.changes():
            self._changed(ROUTER, is_reachable=change is NetworkChange.REGAINED)
            if change is NetworkChange.REGAINED:  # without a router all devices seem absent; now some may be
                for part in tuple(self._timers):
                    self._changed(part, is_reachable=False)

    def _changed(self, part: str, *, is_reachable: bool) -> None:
        """Notify of a part that is not back within the grace."""
        if (timer := self._timers.pop(part, None)) is not None:
            timer.cancel()
        if not is_reachable and (part == ROUTER or len(self._timers) < PARTS):
            self._timers[part] = asyncio.get_running_loop().call_later(self._grace, self._tell, part)

    def _tell(self, part: str) -> None:
        if part == ROUTER or self._parts.network.connected:
            data = {"part": part, "seconds": f"{self._grace:g}"}
            self._notifier.notify("robot-unreachable", data)

    async def _watch_gas(self) -> None:
        is_low, chain = False, self._parts.chain

        async def shortage() -> tuple[int, int]:
            """What the account has, and what it should have: the gas of 20 transactions."""
            return await chain.tokens.eth_balance(), 20 * await least_cost(chain.node)

        while True:
            balance, needed = await chain.retrying(shortage, outages=self._parts.outages)
            if balance < needed and not is_low:
                self._notifier.notify("low-on-gas", {"balance": str(balance), "needed": str(needed)})
            is_low = balance < needed
            await asyncio.sleep(self._gas_interval)


def _target(text: str, secret: bytes) -> Webhook | Script:
    """Raises `ConfigurationError`, without the URL, which may be a secret."""
    if text.startswith(("https://", "http://")):
        with suppress(ValueError):
            if urlsplit(text).hostname and urlsplit(text).port != 0:
                return Webhook(text, secret)
        raise _invalid("notify has a URL without a valid host", 'write "https://HOST/PATH"')
    path = Path(text).expanduser()
    if not path.is_absolute():
        raise _invalid(
            "notify has what is neither a URL nor an absolute path", 'write "https://…" or "/usr/local/bin/say"'
        )
    if not path.is_file() or not path.stat().st_mode & 0o111 or not os.access(path, os.X_OK):
        raise _invalid(f"notify names {path}, which is not a program that can be run", f"chmod +x {path}")
    return Script(path)


def _secret(file: str) -> bytes:
    path = Path(file).expanduser()
    try:
        secret = first_line(path.read_bytes()).strip()
        if secret.startswith(SECRET_PREFIX):
            secret = base64.b64decode(secret.removeprefix(SECRET_PREFIX), validate=True)
    except OSError as error:
        raise _invalid(f"can't read notify_secret_file: {error.strerror}", f"make the file {path}") from None
    except (InvalidData, binascii.Error):
        raise _invalid("notify_secret_file has no usable secret", "whsec_ is followed by base64") from None
    if len(secret) < 16:
        raise _invalid("notify_secret_file has a secret of less than 16 bytes", "`openssl rand -hex 32` makes one")
    return secret


def _invalid(why: str, hint: str) -> ConfigurationError:
    return ConfigurationError(why, hint=hint, code="invalid-notify")
