"""`aira model`: writes, checks and shows descriptions of models."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

import click

from mesh.cli.files import (
    FETCH_SETTINGS,
    description_of,
    only,
    require_readable,
    required_description,
    run_program,
    writing,
)
from mesh.cli.objective import local_file
from mesh.cli.options import PATH, with_json, with_settings
from mesh.cli.output import (
    format_duration,
    format_size,
    interruptible,
    plural,
    print_facts,
    print_json,
    print_line,
    print_result,
    print_table,
    printable,
)
from mesh.errors import InputError
from mesh.recording import Limits, preflight
from mesh.role.models import description_in
from schemas import cid_of_file
from schemas.decoding import without_mark
from schemas.model import DESCRIPTION_LIMITS, ModelDescription, ValueSchema, description_schema

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.settings import Settings
    from schemas.model import ModelLimits, ModelTopic


_HINT: Final = "write `MODEL = agent.model_description(…)` in it"


def description_from(source: Path) -> ModelDescription:
    """The description in a JSON file, or of a Python program's agent.

    Of a program it is the `ModelDescription` that it has, or what the handlers of its agent say, with the title and the
    text from its docstring. Raises `InputError`, `InvalidDescription`.
    """
    if source.suffix != ".py":
        return required_description(source)
    from mesh.agent.agent import Agent

    path = require_readable(source)
    names = run_program(path, Agent)
    described = only(names, ModelDescription, path, hint=_HINT)
    if described is not None:
        return described
    agent = only(names, Agent, path, hint=_HINT)
    if agent is None:
        raise InputError(f"{path} has no agent and no description", hint=_HINT, code="program-unusable")
    text = (names.get("__doc__") or path.stem).strip()
    title = re.split(r"[.:;](?=\s|$)|\n", text, maxsplit=1)[0].strip()[:80]
    return agent.model_description(title, description=" ".join(text.split()) if text != title else "")


@click.group("model")
def command() -> None:
    """Describe models: what an objective plays, what a result holds, what a success is, the price and the duration.

    A model is named by the CID of its file. If the file is a description, agents and people check objectives against
    it. Any other file, such as a text, is a model without a description.
    """


@command.command("new", short_help="write the description of a model")
@click.argument("source", type=PATH)
@click.option("--out", type=PATH, help="file to write [model.json beside SOURCE]")
@click.option("--replace", is_flag=True, help="replace the file if it exists; the model then has another CID")
@with_json
@interruptible
def new(source: Path, out: Path | None, replace: bool, as_json: bool) -> None:
    """Write a description in canonical form, and print its CID.

    SOURCE is a JSON file as people write it (docs/reference/models.md explains the fields), or a Python program with an
    agent (NAME.py). The program is run, but its agent is not: the types of its handlers' messages say what the model
    takes.
    """

    path = out or source.with_name("model.json")
    description = description_from(source)
    if path.exists() and not replace and not path.samefile(source):
        raise InputError(
            f"{path} already exists", hint="give --replace, or another name with --out", code="file-exists"
        )
    with writing(path):
        path.write_bytes(description.encode())
    print_result({"cid": description.cid, "file": str(path)}, f"{description.cid}  {path}", as_json=as_json)


@command.command("check", short_help="check a description, or an objective against it")
@click.argument("model")
@click.argument("objective", required=False)
@with_json
@with_settings(*FETCH_SETTINGS, "objective_size_limit", "objective_expanded_limit")
@interruptible
def check(settings: Settings, model: str, objective: str | None, as_json: bool) -> None:
    """Check MODEL, a file or a CID; with OBJECTIVE, a file or a CID, check whether a robot of that model accepts it.

    The exit code is 1 if the objective does not fit, 2 if the description is not valid. The printed reason is a stable
    code. A model without a description fits any objective that can be played; a file NAME.json must be a description.
    """
    path = local_file(settings, model)
    recording = None if objective is None else local_file(settings, objective)
    description = description_of(path)
    facts = {"cid": cid_of_file(path), "described": description is not None, "ok": True, "reason": "", "detail": ""}
    if recording is not None:
        outcome = preflight(recording, Limits.of(settings), model=description)
        facts |= {"ok": outcome.ok, "reason": outcome.reason, "detail": outcome.detail}
    shown = "valid: a description" if description else "valid: a model without a description"
    if recording is not None:
        shown = "the objective fits" if facts["ok"] else f"{facts['reason']}: {printable(str(facts['detail']))}"
    print_result(facts, f"{facts['cid']}  {shown}", as_json=as_json)
    if not facts["ok"]:
        raise SystemExit(1)


@command.command("show", short_help="show the description of a model")
@click.argument("model")
@with_json
@with_settings(*FETCH_SETTINGS)
@interruptible
def show(settings: Settings, model: str, as_json: bool) -> None:
    """Show MODEL, a file or a CID: its description, or its text if it has none."""
    path = local_file(settings, model)
    description = description_in(path)
    if as_json:
        print_json({"cid": cid_of_file(path), "description": description})
    elif description is None:
        with path.open("rb") as file:
            text = without_mark(file.read(DESCRIPTION_LIMITS.size)).decode(errors="replace")
        print_line("\n".join(printable(line.expandtabs()) for line in text.splitlines()))
    else:
        print_description(description)


@command.command("schema", short_help="print the JSON Schema of descriptions")
def schema() -> None:
    """Print the JSON Schema of descriptions, with which editors check and complete them."""
    click.echo(description_schema(), nl=False)


def print_description(description: ModelDescription) -> None:
    """Print what a model does, and the topics of objectives and results, for people."""
    print_line(description.title)
    if description.description:
        print_line(f"\n{description.description}\n")
    facts = {
        "model": description.cid,
        "price": description.price or None,
        "duration": None if description.seconds is None else _duration(description.seconds),
        "objective": _limits(description.limits),
        "success": description.success.replace("\n", " ") or None,
    }
    print_facts(facts)
    _print_topics("an objective plays", description.objective)
    if description.other_topics:
        print_line("and other topics")
    _print_topics("the result has", description.result)


def _limits(limits: ModelLimits | None) -> str | None:
    if limits is None:
        return None
    messages = None if limits.messages is None else plural(limits.messages, "message")
    seconds = None if limits.seconds is None else _duration(limits.seconds)
    size = None if limits.size is None else format_size(limits.size)
    return "at most " + ", ".join(part for part in (messages, seconds, size) if part)


def _print_topics(title: str, topics: tuple[ModelTopic, ...]) -> None:
    if not topics:
        return
    print_line(f"\n{title}")
    rows = []
    for topic in topics:
        most = "" if topic.max_messages is None else f"at most {topic.max_messages}"
        count = ", ".join(word for word in ("required" * topic.required, most) if word)
        value = topic.value or ValueSchema()
        rows.append((printable(topic.topic), _shown(topic.value, topic.encoding), count, topic.title or value.title))
        for name, schema in value.properties.items():
            rows.append((f"  {name}", _shown(schema), "required" * (name in value.required), schema.title))
    print_table(("topic", "value", "", "title"), rows)


def _shown(schema: ValueSchema | None, encoding: str = "") -> str:
    """A schema in a few words: `number, 0 to 2 m/s`."""
    if schema is None:
        return encoding or "anything"
    words: list[str] = [schema.type or "anything"]
    if schema.enum:
        words = [" | ".join(str(choice) for choice in schema.enum[:8]) + (" | …" if len(schema.enum) > 8 else "")]
    low = f"from {schema.minimum}" if schema.minimum is not None else ""
    low = f"above {schema.exclusive_minimum}" if schema.exclusive_minimum is not None else low
    high = f"to {schema.maximum}" if schema.maximum is not None else ""
    high = f"below {schema.exclusive_maximum}" if schema.exclusive_maximum is not None else high
    if bounds := " ".join(word for word in (low, high, schema.unit) if word):
        words.append(bounds)
    if schema.items is not None:
        words.append(f"of {_shown(schema.items)}")
    if schema.default is not None:
        words.append(f"default {schema.default}")
    return ", ".join(words)


def _duration(seconds: float) -> str:
    return format_duration(round(seconds * 1e9))
