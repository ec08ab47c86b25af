"""The part of the page's interface that is about files: models, objectives, recordings."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec
from aiohttp import web

from bridges.web import recordings
from bridges.web.answers import FOREVER, SANDBOX, answer, body_of, cid_in, number_in, parse_text_cid
from bridges.web.errors import InvalidRequest, PageNotFound
from bridges.web.files import empty_summary
from mesh.recording import NotARecording
from schemas import parse_cid

if TYPE_CHECKING:
    from bridges.web.files import Files


class Form(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Values for a model's topics."""

    model: str
    values: list[dict[str, Any]]


class FileApi:
    """The handlers for files."""

    def __init__(self, files: Files) -> None:
        self._files = files

    def routes(self) -> list[web.RouteDef]:
        """Their routes."""
        file = "/api/v1/files/{cid}"
        return [
            web.get("/api/v1/models/{cid}", self.model),
            web.post("/api/v1/objectives", self.upload),
            web.post("/api/v1/objectives/form", self.form),
            web.get(file, self.file),
            web.get(f"{file}/recording.{{format}}", self.file),
            web.get(f"{file}/summary", self.summary),
            web.get(f"{file}/preflight", self.preflight),
            web.get(f"{file}/messages", self.messages),
            web.get(f"{file}/values", self.values),
            web.get(f"{file}/images/{{number}}", self.image),
        ]

    async def model(self, request: web.Request) -> web.Response:
        return answer(await self._files.model(cid_in(request)))

    async def upload(self, request: web.Request) -> web.Response:
        model = request.query.get("model", "")
        if model:
            parse_cid(model)
        return answer(await self._files.upload(request.content.iter_chunked(1 << 16), model))

    async def form(self, request: web.Request) -> web.Response:
        form = await body_of(request, Form)
        return answer(await self._files.form(form.model, form.values))

    async def file(self, request: web.Request) -> web.StreamResponse:
        cid = cid_in(request)
        path = await self._files.fetch(cid)
        headers = {"Content-Disposition": f'attachment; filename="{cid}"', "Content-Type": "application/octet-stream"}
        return web.FileResponse(path, headers=headers | SANDBOX | FOREVER)

    async def summary(self, request: web.Request) -> web.Response:
        cid = cid_in(request)
        path = await self._files.fetch(cid)
        try:
            found = await self._files.in_thread(recordings.summary, path, cid)
        except NotARecording:
            found = empty_summary(cid, path.stat().st_size)
        return answer(found)

    async def preflight(self, request: web.Request) -> web.Response:
        path = await self._files.fetch(cid_in(request))
        return answer(await self._files.preflight(path, parse_text_cid(request.query.get("model", ""))))

    async def messages(self, request: web.Request) -> web.Response:
        cid = cid_in(request)
        after = number_in(request, "after", -1, least=-1)
        limit = number_in(request, "limit", 100, least=1, most=recordings.MOST_MESSAGES)
        topic = request.query.get("topic", "")
        return answer(await self._files.read(cid, recordings.messages, cid, topic=topic, after=after, limit=limit))

    async def values(self, request: web.Request) -> web.Response:
        if not (topic := request.query.get("topic", "")):
            raise InvalidRequest("give the topic")
        return answer(await self._files.read(cid_in(request), recordings.values, topic))

    async def image(self, request: web.Request) -> web.Response:
        number = request.match_info["number"]
        if not (number.isascii() and number.isdigit() and len(number) < 12):
            raise InvalidRequest("the number of a message is a number")
        found = await self._files.read(cid_in(request), recordings.image, int(number))
        if found is None:
            raise PageNotFound("there is no image in this message")
        data, kind = found
        return web.Response(body=data, content_type=kind, headers=SANDBOX | FOREVER)
