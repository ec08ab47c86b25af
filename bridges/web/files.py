"""Files for the page: fetched by CID, uploaded, made from a form. Bounded in size, number and time."""

from __future__ import annotations

import asyncio
import json
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from bridges.web.errors import InvalidRequest, UploadTooLarge
from bridges.web.recordings import summary
from mesh.errors import ContentError
from mesh.recording import Limits, messages_in, pack, preflight
from mesh.work.models import description_in
from schemas import parse_cid
from schemas.model import MAX_MODEL_SIZE, InvalidDescription

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from bridges.web.components import WebComponents
    from schemas.model import ModelDescription

FETCHES: Final = 8
"""Files that are fetched at a time."""
READERS: Final = 2
"""Recordings that are read at a time."""
PATIENCE: Final = 4.0
"""Seconds without a new block after which a file is not available."""
MOST_LINES: Final = 10_000
LONGEST_TEXT: Final = 20_000
"""Characters of a model without a description."""


class Files:
    """The files of the server's store, and those of the mesh. `upload_limit` is in bytes."""

    def __init__(self, components: WebComponents) -> None:
        self._parts = components
        settings = components.settings
        self.upload_limit: Final = settings.objective_size_limit
        self._limits = Limits(size=settings.objective_size_limit, expanded=settings.objective_expanded_limit)
        self._fetching = asyncio.Semaphore(FETCHES)
        self._reading = asyncio.Semaphore(READERS)

    async def fetch(self, cid: str) -> Path:
        """The file with that CID, from the store or the mesh. Raises `InvalidCid`, `ContentError`.

        A browser does not wait as long as an agent does.
        """
        parse_cid(cid)
        settings = self._parts.settings
        async with self._fetching:
            limit, timeout = settings.objective_expanded_limit, min(settings.fetch_timeout, PATIENCE)
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
            "description": None if described is None else json.loads(described.encode()),
            "text": text,
        }

    async def upload(self, chunks: AsyncIterator[bytes], model: str) -> dict[str, Any]:
        """Store an objective, and check it against a model. Raises `UploadTooLarge`, `QuotaReached`, `StoreFull`."""
        with tempfile.TemporaryDirectory(prefix="aira-upload-") as folder:
            path = Path(folder) / "objective"
            size = 0
            with path.open("wb") as file:
                async for chunk in chunks:
                    size += len(chunk)
                    if size > self.upload_limit:
                        raise UploadTooLarge(f"an objective has at most {self.upload_limit} bytes")
                    await asyncio.to_thread(file.write, chunk)
            return await self._keep(path, model)

    async def form(self, model: str, values: list[dict[str, Any]]) -> dict[str, Any]:
        """Make an objective of the values of a form, as the model describes them. Raises `InvalidRequest`."""
        if len(values) > MOST_LINES:
            raise InvalidRequest(f"a form has at most {MOST_LINES} messages")
        described, _ = await asyncio.to_thread(_described, await self.fetch(model))
        lines = [_line(value, described) for value in values]
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
        about = await self.in_thread(summary, path, cid) if sound else empty_summary(cid, size)
        return {"cid": cid, "size": size, "summary": about, "preflight": checked}


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
        return None, file.read(MAX_MODEL_SIZE).decode(errors="replace")[:LONGEST_TEXT]


def _line(value: dict[str, Any], model: ModelDescription | None) -> bytes:
    """A value of a form as a line of `mesh.recording.packing`."""
    line = {"topic": value.get("topic"), "time": value.get("at", 0), "data": value.get("value")}
    described = model.topic(str(line["topic"])) if model else None
    encoding = described.encoding if described else ""
    if encoding in ("ros1;std_msgs/Empty", "ros1;std_msgs/String"):
        line["type"] = encoding.partition(";")[2]
    elif encoding.startswith("application/json"):
        line["type"] = "json" + encoding.removeprefix("application/json")
    elif encoding:
        line["type"] = encoding
    return json.dumps(line).encode()
