"""The door: translates the Model Context Protocol to the operations of a signer, and back.

It holds no key, and decides nothing: the signer behind the socket does, by the person's policy.
"""

from __future__ import annotations

import json
import logging
import re
from typing import TYPE_CHECKING, Any, Final

import msgspec
from mcp.server.lowlevel import Server
from mcp.shared.exceptions import MCPError
from mcp_types import (
    INTERNAL_ERROR,
    INVALID_PARAMS,
    CallToolRequestParams,
    CallToolResult,
    ElicitRequest,
    ElicitRequestFormParams,
    ElicitResult,
    InputRequiredResult,
    ListResourcesResult,
    ListResourceTemplatesResult,
    ListToolsResult,
    ReadResourceRequestParams,
    ReadResourceResult,
    Resource,
    ResourceTemplate,
    TextContent,
    TextResourceContents,
    Tool,
    ToolAnnotations,
)
from mcp_types.version import MODERN_PROTOCOL_VERSIONS

from bridges.mcp._tools import INSTRUCTIONS, TOOLS
from mesh import __version__
from mesh.errors import AiraError, public_text
from mesh.signer.protocol import FoundRobots, Job, Jobs, SignerAnswer, SignerError, SignerFailure
from schemas.decoding import InvalidData, decode_json

if TYPE_CHECKING:
    from mcp.server.context import ServerRequestContext

    from mesh.signer.client import SignerClient

log = logging.getLogger(__name__)

JSON: Final = "application/json"
_ADDRESS: Final = re.compile(r"0x[0-9a-fA-F]{40}")
_JOB: Final = re.compile(r"job-[0-9a-f]{16}")
LONGEST_SHOWN: Final = 1_000
"""Characters of an order's messages in the question to the person."""

RESOURCES: Final = (
    Resource(
        uri="aira://market",
        name="market",
        title="Market",
        description="The robots that are present on the market.",
        mime_type=JSON,
    ),
    Resource(
        uri="aira://jobs",
        name="jobs",
        title="Jobs",
        description="The latest jobs that were ordered here, the newest first.",
        mime_type=JSON,
    ),
)
TEMPLATES: Final = (
    ResourceTemplate(
        uri_template="aira://robot/{address}",
        name="robot",
        title="Robot",
        description="A robot that is present: what it does, its price, state and record.",
        mime_type=JSON,
    ),
    ResourceTemplate(
        uri_template="aira://contract/{address}",
        name="contract",
        title="Contract",
        description="The job of a contract that was ordered here.",
        mime_type=JSON,
    ),
    ResourceTemplate(
        uri_template="aira://recording/{job_id}",
        name="recording",
        title="Recording",
        description="What the recording of a job has: its topics.",
        mime_type=JSON,
    ),
)


class McpDoor:
    """Serves the tools and resources of a signer; `server` is the SDK's, for any transport."""

    def __init__(self, signer: SignerClient) -> None:
        self._signer = signer
        self.server: Server[Any] = Server(
            "aira-mesh",
            version=__version__,
            title="AIRA mesh",
            instructions=INSTRUCTIONS,
            on_list_tools=self._list_tools,
            on_call_tool=self._call_tool,
            on_list_resources=self._list_resources,
            on_list_resource_templates=self._list_templates,
            on_read_resource=self._read_resource,
        )

    async def _list_tools(self, context: ServerRequestContext[Any], params: Any) -> ListToolsResult:
        return ListToolsResult(
            tools=[
                Tool(
                    name=name,
                    title=tool.title,
                    description=tool.description,
                    input_schema=dict(tool.input_schema),
                    output_schema=dict(tool.output_schema),
                    annotations=ToolAnnotations(
                        read_only_hint=tool.reads_only,
                        destructive_hint=tool.is_destructive,
                        idempotent_hint=True,
                        open_world_hint=True,
                    ),
                )
                for name, tool in TOOLS.items()
            ]
        )

    async def _call_tool(
        self, context: ServerRequestContext[Any], params: CallToolRequestParams
    ) -> CallToolResult | InputRequiredResult:
        if params.name not in TOOLS:
            raise MCPError(INVALID_PARAMS, "there is no such tool; tools/list has them")
        try:
            answer = await self._signer.ask(params.name, _arguments(params.arguments))
            if isinstance(answer, Job) and answer.consent is not None and params.name == "order":
                asked = await self._ask_person(context, params, answer)
                if isinstance(asked, InputRequiredResult):
                    return asked
                answer = asked
        except AiraError as error:
            return _failed(error)
        return CallToolResult(
            content=[TextContent(type="text", text=msgspec.json.encode(answer).decode())],
            structured_content=msgspec.to_builtins(answer),
        )

    async def _ask_person(
        self, context: ServerRequestContext[Any], params: CallToolRequestParams, job: Job
    ) -> Job | InputRequiredResult:
        """Ask the person by the client whether the order may be made, if the policy takes their word from there."""
        consent = job.consent
        assert consent is not None
        if not (consent.by_client and _can_ask(context)):
            return job
        question = ElicitRequestFormParams(message=_question(job, params.arguments or {}), requested_schema=_YES_OR_NO)
        if context.protocol_version in MODERN_PROTOCOL_VERSIONS:
            # The answer comes with the same call again, which is the same job by its key. It is for this consent only.
            answer = (params.input_responses or {}).get(consent.id)
            if answer is None:
                return InputRequiredResult(input_requests={consent.id: ElicitRequest(params=question)})
        else:
            answer = await context.session.elicit_form(
                question.message, question.requested_schema, related_request_id=context.request_id
            )
        if not isinstance(answer, ElicitResult) or answer.action == "cancel":
            return job
        allow = answer.action == "accept" and (answer.content or {}).get("allow") is True
        answered = await self._signer.ask("answer_consent", {"id": consent.id, "allow": allow})
        assert isinstance(answered, Job)
        return answered

    async def _list_resources(self, context: ServerRequestContext[Any], params: Any) -> ListResourcesResult:
        return ListResourcesResult(resources=list(RESOURCES))

    async def _list_templates(self, context: ServerRequestContext[Any], params: Any) -> ListResourceTemplatesResult:
        return ListResourceTemplatesResult(resource_templates=list(TEMPLATES))

    async def _read_resource(
        self, context: ServerRequestContext[Any], params: ReadResourceRequestParams
    ) -> ReadResourceResult:
        try:
            found = await self._resource(str(params.uri))
        except AiraError as error:
            failure = _failure_of(error)
            is_theirs = error.code == "no-such-resource"
            raise MCPError(
                INVALID_PARAMS if is_theirs else INTERNAL_ERROR, failure.message, msgspec.to_builtins(failure)
            ) from None
        text = msgspec.json.encode(found).decode()
        return ReadResourceResult(contents=[TextResourceContents(uri=params.uri, mime_type=JSON, text=text)])

    async def _resource(self, uri: str) -> SignerAnswer:
        """What a URI names. Raises `AiraError`."""
        if uri == "aira://market":
            return await self._signer.ask("find_robots", {"limit": 50})
        if uri == "aira://jobs":
            return await self._signer.ask("jobs", {})
        kind, _, name = uri.removeprefix("aira://").partition("/")
        if uri.startswith("aira://"):
            if kind == "robot" and _ADDRESS.fullmatch(name):
                found = await self._signer.ask("find_robots", {"text": name})
                assert isinstance(found, FoundRobots)
                for robot in found.robots:
                    if robot.address.lower() == name.lower():
                        return robot
            if kind == "contract" and _ADDRESS.fullmatch(name):
                listed = await self._signer.ask("jobs", {"limit": 200})
                assert isinstance(listed, Jobs)
                for job in listed.jobs:
                    if job.contract.lower() == name.lower():
                        return job
            if kind == "recording" and _JOB.fullmatch(name):
                return await self._signer.ask("recording", {"job_id": name})
        raise AiraError("there is no such resource", hint="resources/list has what there is", code="no-such-resource")


_YES_OR_NO: Final = {
    "type": "object",
    "properties": {"allow": {"type": "boolean", "title": "Allow this order, once"}},
    "required": ["allow"],
}


def _arguments(given: dict[str, Any] | None) -> dict[str, Any]:
    """The arguments of a call. Some clients send lists as text in JSON. Raises `SignerError`."""
    arguments = dict(given or {})
    if isinstance(messages := arguments.get("messages"), str):
        try:
            arguments["messages"] = decode_json(messages)
        except InvalidData as error:
            raise SignerError(
                f"messages is no list: {error}"[:200],
                hint='give [{"topic": …, "value": …}]',
                code="invalid-request",
            ) from None
    return arguments


def _can_ask(context: ServerRequestContext[Any]) -> bool:
    """Whether the client shows forms to the person."""
    capabilities = context.session.client_capabilities
    elicitation = None if capabilities is None else capabilities.elicitation
    return elicitation is not None and (elicitation.form is not None or elicitation.url is None)


def _question(job: Job, arguments: dict[str, Any]) -> str:
    """What the person reads, in ASCII, so that no letter looks like another."""
    shown = json.dumps(arguments.get("messages") or arguments.get("objective") or [])
    if len(shown) > LONGEST_SHOWN:
        shown = f"{shown[:LONGEST_SHOWN]}... (shortened)"
    robot = job.robot or "a robot that the policy allows"
    return f"Allow this order? It pays at most {job.cost.text} to {robot} for model {job.model}: {shown}"


_LOOK: Final = "see the tool's description and the schema of its arguments"


def _failure_of(error: AiraError) -> SignerFailure:
    strangers = error.from_strangers if isinstance(error, SignerError) else None
    said = public_text(error.hint or _LOOK)
    return SignerFailure(code=error.code, message=public_text(error), next=said, from_strangers=strangers)


def _failed(error: AiraError) -> CallToolResult:
    """The result of a call that was refused or failed."""
    failure = msgspec.to_builtins(_failure_of(error))
    return CallToolResult(
        content=[TextContent(type="text", text=json.dumps(failure, ensure_ascii=False))],
        structured_content=failure,
        is_error=True,
    )
