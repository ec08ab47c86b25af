"""The client of a signer: what doors, pages and commands use. It has no key, no chain and no Zenoh.

async with SignerClient(folder / "door.sock") as signer:
    job = await signer.order(model="Qm…", messages=[("/blink", "red")], cost="1 XRT", idempotency_key="…")
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self, TypeVar

import aiohttp
import msgspec

from mesh.errors import AiraError, InputError
from mesh.settings.chains import ORDER_SECONDS
from mesh.signer import protocol
from mesh.signer.protocol import (
    DOOR,
    LARGEST_ANSWER,
    LARGEST_REQUEST,
    OWNER,
    Message,
    RequestTooLarge,
    SignerError,
    SignerUnavailable,
)
from schemas.decoding import InvalidData, decode_json

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path
    from types import TracebackType

A = TypeVar("A", bound=protocol.SignerAnswer)


class SignerCallLimits(NamedTuple):
    """What a client asks of the signer at once, and how many seconds it waits."""

    calls: int = 64
    """Calls in progress, besides …"""
    looks: int = 192
    """… those that look at a job, and may wait for it to change."""
    connecting: float = 5.0
    """For which it tries to connect."""
    answer: float = 180.0
    """For the answer: an order asks robots, and perhaps fetches an objective, before it is answered."""


CALL_LIMITS: Final = SignerCallLimits()


class SignerClient:
    """Talks to the signer on a socket: `async with SignerClient(path) as signer`. Usable by many tasks at once.

    Each method raises a `SignerError` with the code and the hint of the signer's refusal, `SignerUnavailable` if it
    does not answer, `InputError` for a request that can't be one, and `AiraError` (`too-many-calls`) for one too many.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._session: aiohttp.ClientSession | None = None
        self._in_progress: Counter[bool] = Counter()

    async def __aenter__(self) -> Self:
        timeout = aiohttp.ClientTimeout(total=CALL_LIMITS.answer, sock_connect=CALL_LIMITS.connecting)
        connector = aiohttp.UnixConnector(path=str(self._path), limit=0)
        self._session = aiohttp.ClientSession(connector=connector, timeout=timeout)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._session is not None:
            await self._session.close()
            self._session = None

    async def find_robots(self, *, model: str = "", text: str = "", limit: int = 20) -> protocol.FoundRobots:
        return await self._call(protocol.FoundRobots, "find_robots", model=model, text=text, limit=limit)

    async def describe_model(self, model: str) -> protocol.DescribedModel:
        """What orders of a model (CID or name) must say, and what the policy allows of it."""
        return await self._call(protocol.DescribedModel, "describe_model", model=model)

    async def quote(
        self, *, model: str, messages: Iterable[tuple[str, Any]] = (), objective: str = ""
    ) -> protocol.FoundQuotes:
        """See `AskQuotes`; `messages` are topics with values."""
        listed = _messages(messages)
        return await self._call(protocol.FoundQuotes, "quote", model=model, messages=listed, objective=objective)

    async def order(
        self,
        *,
        model: str,
        cost: str,
        idempotency_key: str,
        messages: Iterable[tuple[str, Any]] = (),
        objective: str = "",
        robot: str = "cheapest",
        deadline_seconds: int = ORDER_SECONDS,
        note: str = "",
    ) -> protocol.Job:
        """See `OrderJob`; `messages` are topics with values."""
        return await self._call(
            protocol.Job,
            "order",
            model=model,
            messages=_messages(messages),
            objective=objective,
            robot=robot,
            cost=cost,
            deadline_seconds=deadline_seconds,
            idempotency_key=idempotency_key,
            note=note,
        )

    async def job(self, job_id: str, *, revision: int = -1, wait_seconds: float = 0.0) -> protocol.Job:
        return await self._call(protocol.Job, "job", job_id=job_id, revision=revision, wait_seconds=wait_seconds)

    async def jobs(self, *, limit: int = 20) -> tuple[protocol.Job, ...]:
        """The latest jobs, the newest first."""
        return (await self._call(protocol.Jobs, "jobs", limit=limit)).jobs

    async def stop_job(self, job_id: str, *, why: str = "") -> protocol.Job:
        return await self._call(protocol.Job, "stop_job", job_id=job_id, why=why)

    async def withdraw(self, job_id: str) -> protocol.Job:
        return await self._call(protocol.Job, "withdraw", job_id=job_id)

    async def recording(self, job_id: str, *, topic: str = "", first: int = 0, limit: int = 50) -> protocol.Recording:
        return await self._call(protocol.Recording, "recording", job_id=job_id, topic=topic, first=first, limit=limit)

    async def verify(self, job_id: str) -> protocol.Verification:
        return await self._call(protocol.Verification, "verify", job_id=job_id)

    async def balance(self) -> protocol.AccountFunds:
        return await self._call(protocol.AccountFunds, "balance")

    async def statement(self, *, first: str = "", last: str = "", limit: int = 100) -> protocol.AccountStatement:
        return await self._call(protocol.AccountStatement, "statement", first=first, last=last, limit=limit)

    async def consents(self) -> tuple[protocol.Consent, ...]:
        """The orders that wait for a person's yes. This and what follows is on the owner's socket only."""
        return (await self._call(protocol.Consents, "consents")).consents

    async def approve(self, consent: str) -> protocol.Job:
        """Allow the order of a consent (its id), once."""
        return await self._call(protocol.Job, "approve", id=consent)

    async def deny(self, consent: str) -> protocol.Job:
        """Don't allow it."""
        return await self._call(protocol.Job, "deny", id=consent)

    async def log(self, *, first: int | None = None, limit: int = 100) -> protocol.LogEntries:
        return await self._call(protocol.LogEntries, "log", first=first, limit=limit)

    async def verify_log(self) -> protocol.LogVerified:
        return await self._call(protocol.LogVerified, "verify_log")

    async def policy(self) -> protocol.PolicyInUse:
        return await self._call(protocol.PolicyInUse, "policy")

    async def use_policy(self) -> protocol.PolicyInUse:
        return await self._call(protocol.PolicyInUse, "use_policy")

    async def ask(self, operation: str, fields: Mapping[str, Any]) -> protocol.SignerAnswer:
        """Any operation by its name in `DOOR` or `OWNER`, with the fields of its request."""
        known = DOOR.get(operation) or OWNER[operation]
        try:
            body = msgspec.json.encode(msgspec.convert(fields, known.request))
        except (msgspec.ValidationError, TypeError, OverflowError, RecursionError) as error:
            raise InputError(f"not a request for {operation}: {error}"[:300], code="invalid-request") from None
        if len(body) > LARGEST_REQUEST:
            raise RequestTooLarge
        is_look = operation == "job"
        if self._in_progress[is_look] >= (CALL_LIMITS.looks if is_look else CALL_LIMITS.calls):
            raise AiraError(
                "too many calls at once", hint="wait for the answers to earlier ones", code="too-many-calls"
            )
        self._in_progress[is_look] += 1
        try:
            status, data = await self._post(operation, body)
        finally:
            self._in_progress[is_look] -= 1
        try:
            if status == 200:
                return decode_json(data, known.answer)
            failure = decode_json(data, protocol.ErrorAnswer).error
        except InvalidData:
            raise SignerUnavailable("what answers on the socket is no signer of this version") from None
        raise SignerError(failure.message, hint=failure.next, code=failure.code, from_strangers=failure.from_strangers)

    async def _call(self, kind: type[A], operation: str, **fields: Any) -> A:
        answer = await self.ask(operation, fields)
        assert isinstance(answer, kind)
        return answer

    async def _post(self, operation: str, body: bytes) -> tuple[int, bytes]:
        if self._session is None:
            raise AiraError("the client is not open", hint="use it inside `async with`", code="closed-error")
        headers = {"Content-Type": "application/json"}
        try:
            async with self._session.post(f"http://signer/v1/{operation}", data=body, headers=headers) as response:
                data = await response.content.read(LARGEST_ANSWER + 1)
                while len(data) <= LARGEST_ANSWER and (more := await response.content.read(LARGEST_ANSWER)):
                    data += more
                if len(data) > LARGEST_ANSWER:
                    raise SignerUnavailable("what answers on the socket is no signer: its answer is too long")
                return response.status, data
        except (TimeoutError, aiohttp.ClientError, OSError) as error:
            is_there = not isinstance(error, aiohttp.ClientConnectorError)
            raise SignerUnavailable(
                "the signer did not answer in time, or ended meanwhile" if is_there else "no signer runs here",
                hint="start `aira signer`, with the same --data-dir; then ask again, for an order with the same key",
            ) from None


def _messages(messages: Iterable[tuple[str, Any]]) -> tuple[Message, ...]:
    return tuple(Message(topic=topic, value=value) for topic, value in messages)
