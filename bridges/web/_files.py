"""Files for the page: fetched by CID, uploaded, made from a form; and what recordings hold. Bounded in size and time.

What is in a recording comes from strangers; it is returned as data, and never as HTML. The functions that read one
block: they run in a thread.
"""

from __future__ import annotations

import asyncio
import math
import tempfile
from collections import Counter
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from bridges.web._access import WebError
from mesh.errors import ContentError
from mesh.recording import (
    GENEROUS,
    Limits,
    described_line,
    messages_in,
    numbers_of,
    open_objective,
    pack,
    preflight,
    shown_value,
)
from mesh.role.models import description_in
from schemas import parse_cid
from schemas.decoding import decode_json
from schemas.model import DESCRIPTION_LIMITS, InvalidDescription
from schemas.profiles import PROFILE_LIMITS

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator

    from bridges.web.components import WebComponents
    from mesh.recording import Objective, Played
    from schemas.model import ModelDescription


class FileLimits(NamedTuple):
    """What is read of a file."""

    messages: int = 500
    """Messages in one answer."""
    plotted: int = 1_000_000
    """Messages of a topic that are read for a plot …"""
    points: int = 4000
    """… and points of it."""


FILE_LIMITS: Final = FileLimits()
_MAGIC: Final = (
    (b"\x89PNG\r\n\x1a\n", "image/png"),
    (b"\xff\xd8\xff", "image/jpeg"),
    (b"GIF87a", "image/gif"),
    (b"GIF89a", "image/gif"),
    (b"BM", "image/bmp"),
)


def summary_of(path: Path, cid: str) -> dict[str, Any]:
    """What a file holds; a file that is no recording has no topics. Raises `CorruptRecording` and others."""
    recording = open_objective(path, GENEROUS)
    counts: Counter[tuple[str, str]] = Counter()
    shown: dict[tuple[str, str], str] = {}
    for message in recording.messages():
        topic = message.topic, _role(message)
        counts[topic] += 1
        if shown.get(topic, "none") == "none":
            shown[topic] = _how_shown(message)
    kinds: dict[str, list[str]] = {}
    for one in recording.topics:
        kinds.setdefault(one.name, []).append(one.type.zenoh_encoding)
    return {
        "cid": cid,
        "format": recording.format,
        "size": recording.size,
        "messages": recording.count,
        "startNs": str(recording.start_ns),
        "durationNs": str(recording.duration_ns),
        "topics": [
            {"topic": name, "role": role, "messages": count, "types": kinds[name], "shown": shown[name, role]}
            for (name, role), count in islice(counts.items(), 512)
        ],
        "metadata": recording.metadata,
        "attachments": [
            {"name": one.name, "mediaType": one.media_type, "size": one.size} for one in recording.attachments
        ],
    }


def messages_of(path: Path, cid: str, *, topic: str, after: int, limit: int) -> dict[str, Any]:
    """Up to `limit` messages behind the one with the number `after` (-1: from the first)."""
    recording = open_objective(path, GENEROUS)
    found: list[dict[str, Any]] = []
    more = None
    for number, message in _of_topic(recording, topic, after + 1):
        if len(found) == min(limit, FILE_LIMITS.messages):
            more = found[-1]["number"] if found else after
            break
        found.append(_facts(message, number, recording.start_ns, cid))
    return {"messages": found, "next": more}


def columns_of(path: Path, topic: str) -> dict[str, Any]:
    """The numbers of a topic as columns, at most `FILE_LIMITS.points` of each, evenly taken."""
    recording = open_objective(path, GENEROUS)
    count = sum(1 for _ in _of_topic(recording, topic, 0))
    step = max(1, math.ceil(min(count, FILE_LIMITS.plotted) / FILE_LIMITS.points))
    at: list[float] = []
    columns: dict[str, list[float | None]] = {}
    for place, (_, message) in enumerate(islice(_of_topic(recording, topic, 0), FILE_LIMITS.plotted)):
        if place % step:
            continue
        at.append((message.log_time_ns - recording.start_ns) / 1e9)
        for name, number in numbers_of(message):
            name = name.removeprefix(".")
            if name in columns or len(columns) < 32:
                column = columns.setdefault(name, [])
                column += [None] * (len(at) - 1 - len(column))
                column.append(number)
    listed = [{"name": name, "values": column + [None] * (len(at) - len(column))} for name, column in columns.items()]
    return {"topic": topic, "messages": count, "points": len(at), "at": at, "columns": listed}


def image_of(path: Path, number: int) -> tuple[bytes, str] | None:
    """The image in the message of that number, and its media type."""
    message = next(open_objective(path, GENEROUS).messages(from_index=number), None)
    return None if message is None else picture_in(message)


def picture_of(path: Path) -> tuple[bytes, str] | None:
    """The picture that a file is, and its media type: none larger than a robot's may be."""
    if path.stat().st_size > PROFILE_LIMITS.picture:
        return None
    data = path.read_bytes()
    kind = _kind_of(data)
    return None if kind is None else (data, kind)


def _of_topic(recording: Objective, topic: str, first: int) -> Iterator[tuple[int, Played]]:
    """The messages from a number on, those of a topic or all."""
    numbered = enumerate(recording.messages(from_index=first), first)
    return ((number, message) for number, message in numbered if not topic or message.topic == topic)


def _facts(message: Played, number: int, start_ns: int, cid: str) -> dict[str, Any]:
    value, is_cut = shown_value(message)
    return {
        "number": number,
        "topic": message.topic,
        "role": _role(message),
        "type": message.type.zenoh_encoding,
        "at": (message.log_time_ns - start_ns) / 1e9,
        "size": len(message.payload),
        "value": value,
        "cut": is_cut,
        "image": f"/api/v1/files/{cid}/images/{number}" if picture_in(message) else None,
    }


def _role(message: Played) -> str:
    return message.role or "objective"


def _how_shown(message: Played) -> str:
    """How the messages of a topic are shown: `values`, `image`, `text`, `bytes` or `none`."""
    if picture_in(message):
        return "image"
    value = message.value
    if value is None:
        return "none"
    if isinstance(value, bytes):
        return "bytes"
    return "values" if next(numbers_of(message), None) else "text"


def picture_in(message: Played) -> tuple[bytes, str] | None:
    """The image in a message: its payload, or that of a ROS 1 compressed image. Never SVG, which may hold scripts."""
    data = message.payload
    if message.type.encoding == "ros1" and message.type.schema_name == "sensor_msgs/CompressedImage":
        data = _third_field(data)
    elif message.type.encoding in ("json", "ros1", "cdr", "protobuf"):
        return None
    kind = _kind_of(data)
    return None if kind is None else (data, kind)


def _kind_of(data: bytes) -> str | None:
    """The media type of an image, by its first bytes."""
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return "image/webp"
    return next((kind for magic, kind in _MAGIC if data.startswith(magic)), None)


def _third_field(payload: bytes) -> bytes:
    """The data of a sensor_msgs/CompressedImage: behind a header (12 bytes and a text), and the text of its format."""
    at = 12
    for _ in range(2):
        at += 4 + int.from_bytes(payload[at : at + 4], "little")
    length = int.from_bytes(payload[at : at + 4], "little")
    data = payload[at + 4 : at + 4 + length]
    return data if len(data) == length else b""


class UploadLimits(NamedTuple):
    """What is taken of senders."""

    at_once: int = 8
    """Uploads at a time …"""
    per_sender: int = 2
    """… and those of one sender."""
    lines: int = 10_000
    """Messages of a form."""


UPLOAD_LIMITS: Final = UploadLimits()


@dataclass(eq=False)
class Upload:
    """One upload under way: `size` bytes of it lie in a temporary file."""

    sender: str
    size: int = 0


class Files:
    """The files of the server's store, and those of the mesh. `upload_limit` is in bytes."""

    def __init__(self, components: WebComponents) -> None:
        self._parts = components
        settings = components.settings
        self.upload_limit: Final = settings.objective_size_limit
        self._limits = Limits.of(settings)
        self._uploads: list[Upload] = []
        self._fetching = asyncio.Semaphore(8)  # files that are fetched at a time
        self._reading = asyncio.Semaphore(2)  # recordings that are read at a time

    async def fetch(self, cid: str) -> Path:
        """The file with that CID, from the store or the mesh. Raises `InvalidCid`, `ContentError`.

        A browser does not wait as long as an agent does.
        """
        parse_cid(cid)
        settings = self._parts.settings
        async with self._fetching:
            # Seconds without a new block after which a file is not available.
            limit, timeout = settings.objective_expanded_limit, min(settings.fetch_timeout, 4.0)
            return await self._parts.exchange.fetch(cid, size_limit=limit, timeout=timeout)

    async def in_thread(self, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """Call what reads a file, in a thread, few at a time."""
        async with self._reading:
            return await asyncio.to_thread(function, *arguments, **options)

    async def read(self, cid: str, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """Call `function(path, …)` for the file with that CID."""
        return await self.in_thread(function, await self.fetch(cid), *arguments, **options)

    async def model(self, cid: str) -> dict[str, Any]:
        """The description of a model, or its text."""
        path = await self.fetch(cid)
        described, text = await asyncio.to_thread(_described, path)
        return {
            "cid": cid,
            "described": described is not None,
            "description": None if described is None else decode_json(described.encode()),
            "text": text,
        }

    async def upload(
        self, chunks: AsyncIterator[bytes], model: str, *, sender: str, stated: int | None = None
    ) -> dict[str, Any]:
        """Store an objective, and check it against a model. `stated` is the size that its sender states.

        Raises `WebError`, `StoreFull`.
        """
        if stated is not None and stated > self.upload_limit:
            raise self._too_large()
        with self._upload_of(sender) as upload, tempfile.TemporaryDirectory(prefix="aira-upload-") as folder:
            path = Path(folder) / "objective"
            with path.open("wb") as file:
                async for chunk in chunks:
                    if upload.size + len(chunk) > self.upload_limit:
                        raise self._too_large()
                    upload.size += len(chunk)
                    self._check_uploads(sender)
                    await asyncio.to_thread(file.write, chunk)
            return await self._keep(path, model)

    @contextmanager
    def _upload_of(self, sender: str) -> Iterator[Upload]:
        """An upload of a sender, in the body. Raises `WebError`."""
        if (
            sum(upload.sender == sender for upload in self._uploads) >= UPLOAD_LIMITS.per_sender
            or len(self._uploads) >= UPLOAD_LIMITS.at_once
        ):
            raise _busy()
        upload = Upload(sender)
        self._uploads.append(upload)
        try:
            yield upload
        finally:
            self._uploads.remove(upload)

    def _check_uploads(self, sender: str) -> None:
        """The temporary files of one sender have as many bytes as one upload, at most, and all twice as many."""
        own = sum(upload.size for upload in self._uploads if upload.sender == sender)
        if own > self.upload_limit or sum(upload.size for upload in self._uploads) > 2 * self.upload_limit:
            raise _busy()

    def _too_large(self) -> WebError:
        return WebError(f"an objective has at most {self.upload_limit} bytes", code="upload-too-large")

    async def form(self, model: str, values: list[dict[str, Any]]) -> dict[str, Any]:
        """Make an objective of the values of a form, as the model describes them. Raises `WebError`."""
        if len(values) > UPLOAD_LIMITS.lines:
            raise WebError(f"a form has at most {UPLOAD_LIMITS.lines} messages")
        described, _ = await asyncio.to_thread(_described, await self.fetch(model))
        lines = [
            described_line(str(one.get("topic")), one.get("value"), described, time=one.get("at", 0)) for one in values
        ]
        with tempfile.TemporaryDirectory(prefix="aira-form-") as folder:
            path = Path(folder) / "objective.mcap"
            await self.in_thread(lambda: pack(messages_in(lines), path))
            return await self._keep(path, model)

    async def preflight(self, path: Path, model: str) -> dict[str, Any]:
        """Whether an objective fits a model (empty: any). A model that can't be fetched is not checked."""
        description = None
        if model:
            with suppress(ContentError):
                description, _ = await asyncio.to_thread(_described, await self.fetch(model))
        outcome = await self.in_thread(preflight, path, self._limits, model=description)
        return {"ok": outcome.ok, "reason": outcome.reason, "detail": outcome.detail}

    async def _keep(self, path: Path, model: str) -> dict[str, Any]:
        cid = await asyncio.to_thread(self._parts.store.put_file, path)
        checked = await self.preflight(path, model)
        size = (await asyncio.to_thread(path.stat)).st_size
        sound = checked["reason"] not in ("not-a-recording", "too-large", "expands-too-much", "corrupt")
        about = await self.in_thread(summary_of, path, cid) if sound else empty_summary(cid, size)
        return {"cid": cid, "size": size, "summary": about, "preflight": checked}


def _busy() -> WebError:
    return WebError("other uploads are under way", hint="try again when they have ended", code="uploads-busy")


def empty_summary(cid: str, size: int) -> dict[str, Any]:
    """The summary of a file that is no recording."""
    numbers = {"messages": 0, "startNs": "0", "durationNs": "0"}
    return {"cid": cid, "format": "file", "size": size, **numbers, "topics": [], "metadata": {}, "attachments": []}


def _described(path: Path) -> tuple[ModelDescription | None, str | None]:
    """The description in a model's file, or else the beginning of its text."""
    with suppress(InvalidDescription):
        if (description := description_in(path)) is not None:
            return description, None
    with path.open("rb") as file:
        # Characters of a model without a description.
        return None, file.read(DESCRIPTION_LIMITS.size).decode(errors="replace")[:20_000]
