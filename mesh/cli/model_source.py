"""What `aira model new` reads a description from: JSON as people write it, or a Python program with an agent."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from mesh.cli.errors import ProgramUnusable
from mesh.cli.files import require_readable
from mesh.cli.program import only, run_program
from schemas.model import MAX_MODEL_SIZE, ModelDescription, parse_description

if TYPE_CHECKING:
    from pathlib import Path

_HINT: Final = "write `MODEL = agent.model_description(…)` in it"


def description_from(source: Path) -> ModelDescription:
    """The description in a JSON file, or of a Python program's agent.

    Of a program it is the `ModelDescription` that it has, or what the handlers of its agent say, with the title and the
    text from its docstring. Raises `FileUnreadable`, `ProgramUnusable`, `InvalidDescription`.
    """
    with require_readable(source).open("rb") as file:
        data = file.read(MAX_MODEL_SIZE + 1)
    return _of_program(source) if source.suffix == ".py" else parse_description(data)


def _of_program(path: Path) -> ModelDescription:
    from mesh.agent import Agent

    names = run_program(path, Agent)
    described = only(names, ModelDescription, path, hint=_HINT)
    if described is not None:
        return described
    agent = only(names, Agent, path, hint=_HINT)
    if agent is None:
        raise ProgramUnusable(f"{path} has no agent and no description", hint=_HINT)
    text = (names.get("__doc__") or path.stem).strip()
    title = re.split(r"[.:;](?=\s|$)|\n", text, maxsplit=1)[0].strip()[:80]
    return agent.model_description(title, description=" ".join(text.split()) if text != title else "")
