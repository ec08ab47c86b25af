"""The pages about the commands, from their definitions: one for each command of `aira` with all below it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import click

from documentation.markdown import escaped, paragraphs
from mesh.cli import main
from mesh.settings import OPTIONS

if TYPE_CHECKING:
    from collections.abc import Iterator

HEAD: Final = """\
# Commands

`aira COMMAND --help` shows the same as these pages. Commands with `--json` print JSON only to stdout. A command exits
with 0 when it has done its work, with 2 for bad input or settings, and with 1 otherwise; its last line then ends with
a [code](../codes.md). Flags that are [settings](../settings.md) can also be set by a variable or in a file.

| command | does |
|---|---|
"""


def command_pages() -> dict[str, str]:
    """The text of each page, by its name."""
    context = click.Context(main, info_name="aira")
    commands = {name: command for name in main.list_commands(context) if (command := main.get_command(context, name))}
    rows = [
        f"| [`aira {name}`]({name}.md) | {escaped(command.get_short_help_str(300))} |\n"
        for name, command in commands.items()
    ]
    pages = {f"{name}.md": "\n".join(_described(command, context, name, 1)) for name, command in commands.items()}
    return {"index.md": HEAD + "".join(rows), **pages}


def _described(command: click.Command, parent: click.Context, name: str, depth: int) -> Iterator[str]:
    """A command and those below it, as lines of Markdown. Abbreviations of other commands are left out."""
    context = click.Context(command, info_name=name, parent=parent)
    yield f"{'#' * min(depth, 3)} {context.command_path}\n"
    yield "```text"
    yield f"{context.command_path} {' '.join(command.collect_usage_pieces(context))}"
    yield "```\n"
    yield paragraphs(command.help or "")
    options = [one for one in command.get_params(context) if isinstance(one, click.Option) and not one.hidden]
    for option in options:
        if option.name not in OPTIONS and option.name != "help":
            yield f"`{_spelled(option, context)}`"
            yield f":   {escaped(_meaning(option, context))}\n"
    if settings := [option.name for option in options if option.name in OPTIONS]:
        links = (f"[`--{name.replace('_', '-')}`](../settings.md#{name})" for name in sorted(map(str, settings)))
        yield f"Settings: {', '.join(links)}.\n"
    if isinstance(command, click.Group):
        for inner in command.list_commands(context):
            if (below := command.get_command(context, inner)) and not below.hidden:
                yield from _described(below, context, inner, depth + 1)


def _spelled(option: click.Option, context: click.Context) -> str:
    record = option.get_help_record(context)
    return record[0] if record else option.opts[0]


def _meaning(option: click.Option, context: click.Context) -> str:
    record = option.get_help_record(context)
    text = " ".join((record[1] if record else "").split())
    return f"{text[:1].upper()}{text[1:]}" if text[1:2].islower() else text
