"""What `aira model new` reads a description from: JSON as people write it, or a Python program with an agent."""

from __future__ import annotations

import re
import runpy
import sys
from contextlib import contextmanager
from traceback import extract_tb
from typing import TYPE_CHECKING, Any, Final, NoReturn, TypeVar

from mesh.cli.errors import ProgramUnusable
from mesh.cli.files import require_readable
from mesh.errors import AiraError
from schemas.model import MAX_MODEL_SIZE, ModelDescription, parse_description

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

K = TypeVar("K")

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

    with _importing_from(path.parent), _not_running(Agent, path) as started:
        try:
            names = runpy.run_path(str(path), run_name=path.stem)
        except AiraError:
            raise
        except (Exception, SystemExit) as error:  # whatever the program raises
            if started:  # `run_to_end` has reported it
                raise
            lines = [frame.lineno for frame in extract_tb(error.__traceback__) if frame.filename == str(path)]
            where = f"{path}:{lines[-1]}" if lines else str(path)
            why = " ".join(str(error).split())
            raise ProgramUnusable(f"can't run {where}: {type(error).__name__}: {why}") from error
    described = _only(names, ModelDescription, path)
    if described is not None:
        return described
    agent = _only(names, Agent, path)
    if agent is None:
        raise ProgramUnusable(f"{path} has no agent and no description", hint=_HINT)
    text = (names.get("__doc__") or path.stem).strip()
    title = re.split(r"[.:;](?=\s|$)|\n", text, maxsplit=1)[0].strip()[:80]
    return agent.model_description(title, description=" ".join(text.split()) if text != title else "")


def _only(names: dict[str, Any], kind: type[K], path: Path) -> K | None:
    """The one object of that kind that a program has, None if there is none. Raises `ProgramUnusable` for several."""
    found = {name: value for name, value in names.items() if isinstance(value, kind)}
    if len(set(map(id, found.values()))) > 1:
        raise ProgramUnusable(f"{path} has several objects {kind.__name__}: {', '.join(sorted(found))}", hint=_HINT)
    return next(iter(found.values()), None)


@contextmanager
def _importing_from(folder: Path) -> Iterator[None]:
    """Import modules from there, as a program does that Python runs."""
    sys.path.insert(0, str(folder.resolve()))
    try:
        yield
    finally:
        sys.path.remove(str(folder.resolve()))


@contextmanager
def _not_running(kind: type[Any], path: Path) -> Iterator[list[Any]]:
    """Let `agent.run()`, with which many programs end, do nothing, and let `async with agent` fail.

    Yields the list of the agents that the program would have started.
    """
    run, enter = kind.run, kind.__aenter__
    started: list[Any] = []

    async def refuse(agent: Any) -> NoReturn:
        started.append(agent)
        raise ProgramUnusable(f"{path} starts an agent", hint='do that below `if __name__ == "__main__":`')

    kind.run, kind.__aenter__ = lambda agent: None, refuse
    try:
        yield started
    finally:
        kind.run, kind.__aenter__ = run, enter
