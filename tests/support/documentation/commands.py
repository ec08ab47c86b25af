"""The commands in the pages' blocks, taken apart as a shell does, and what `aira` would say of their words."""

from __future__ import annotations

import re
import shlex
from typing import TYPE_CHECKING, Final

import click

from mesh.cli import main

if TYPE_CHECKING:
    from collections.abc import Iterator

ENDS_COMMAND: Final = frozenset({"|", "||", "&&", ";", "&", "(", ")", "do", "done", "for", "{", "}"})
PROMPT: Final = "$ "


def scripts(text: str) -> str:
    """What a reader types of a block: all of it, or the lines after a prompt, of which what is printed is no part."""
    lines = text.replace("\\\n", " ").split("\n")
    typed = [line.removeprefix(PROMPT) for line in lines if line.startswith(PROMPT)]
    return "\n".join(typed or lines)


def commands(script: str) -> Iterator[list[str]]:
    """The words of each command of a script, without variables before it, and without where it reads and writes."""
    for inner in re.findall(r"\$\(([^()]*)\)", script):
        yield from commands(inner)
    for line in re.sub(r"\bfor \w+ in [^;]*;", "", script).split("\n"):
        words = shlex.shlex(re.sub(r"\$\(([^()]*)\)", "X", line), posix=True, punctuation_chars=True)
        words.whitespace_split = True
        words.commenters = "#"
        command: list[str] = []
        skip = False
        for word in [*words, ";"]:
            if skip:
                skip = False
            elif word in ENDS_COMMAND:
                if command:
                    yield command
                command = []
            elif word in (">", "<", ">>", ">&"):
                skip = True
            elif command or not re.fullmatch(r"\w+=.*", word):
                command.append(word)


def wrong_words(words: list[str]) -> str:
    """Why `aira` refuses these words after its name, or nothing.

    Values may be placeholders, so only choices are checked.
    """
    command: click.Command = main
    context = click.Context(main, info_name="aira")
    rest = [word for word in words if word != "…"]
    while isinstance(command, click.Group) and rest and not rest[0].startswith("-"):
        below = command.get_command(context, rest[0])
        if below is None:
            if command.invoke_without_command:
                break
            return f"{context.command_path} has no command {rest[0]!r}"
        context = click.Context(below, info_name=rest.pop(0), parent=context)
        command = below
    try:
        values, extra, _ = command.make_parser(context).parse_args(rest)
    except click.UsageError as error:
        return f"{context.command_path}: {error.format_message()}"
    if extra:
        return f"{context.command_path} takes no {extra[0]!r}"
    for option in command.params:
        given = values.get(str(option.name))
        if isinstance(option.type, click.Choice) and isinstance(given, str) and given not in option.type.choices:
            return f"{context.command_path}: {given!r} is none of {', '.join(map(str, option.type.choices))}"
    return ""
