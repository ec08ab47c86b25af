"""`aira new`: a project that works at once, from the templates in `mesh/dev/templates`."""

from __future__ import annotations

import re
import sys
from importlib.metadata import version
from pathlib import Path
from string import Template
from typing import Final, NamedTuple

import click

from mesh.cli.model import description_from
from mesh.cli.options import PATH, with_json
from mesh.cli.output import interruptible, print_result
from mesh.errors import InputError

PACKAGES: Final = Path(__file__).parents[2]
TEMPLATES: Final = PACKAGES / "mesh" / "dev" / "templates"
SUFFIX: Final = ".template"
RUNS: Final = "aira up --run $module.py"


class ProjectKind(NamedTuple):
    """A kind of project: what it needs, how it is tried, and where its templates are."""

    extras: str
    summary: str
    explained: str
    try_it: str = RUNS
    parts: tuple[str, ...] = ("project", "service")
    """Folders of templates besides its own."""
    dev_extras: str = "testing,web"
    command: str = "python $module.py"
    variable: str = ""
    """What the program reads from its environment besides settings, with an example: `NAME=value`."""


MARKET: Final = """The second command runs a market with it on this machine, and prints the address of a page,
where you order. It starts again when you change a file."""
DEPLOY: Final = "`deploy` has what a server needs."
KINDS: Final = {
    "robot": ProjectKind("chain", "A robot that blinks its light for 1 XRT.", f"{MARKET} {DEPLOY}"),
    "device": ProjectKind(
        "chain,serial",
        "A board with a lamp that shines for 1 XRT.",
        f"{MARKET} `board` is its sketch for an Arduino Uno;\n"
        "`aira edge PORT --agent ADDRESS` connects it, where ADDRESS is the account that the robot logs.\n"
        "Without a board, `python -m bridges.serial.firmware board -o build` compiles the sketch, and\n"
        f"`aira board run build/board.elf --tty ./uno` simulates it at the port `./uno`. {DEPLOY}",
    ),
    "client": ProjectKind(
        "chain",
        "A program that orders a job and pays for it.",
        "The second command orders from the robots of a model. It needs a market and an account:\n"
        "`aira up` prints the lines that select them.",
        "python $module.py MODEL",
        ("project",),
    ),
    "ros2": ProjectKind(
        "chain,ros2",
        "Work of a ROS 2 robot, for 1 XRT.",
        f"{MARKET}\n`python twin.py` is a robot without hardware. `ROS2_CONNECT` names a real robot's router. {DEPLOY}",
        variable="ROS2_CONNECT=tcp/127.0.0.1:7448",
    ),
    "ros1": ProjectKind(
        "chain",
        "Work of a ROS 1 robot, for 1 XRT.",
        f"{MARKET}\n`python twin.py` is a robot without hardware. `ROS_MASTER_URI` names a real robot's master.\n"
        f"{DEPLOY} Nodes of the network of 2018 need no program: start `aira bridge ros1` beside them.",
        variable="ROS_MASTER_URI=http://127.0.0.1:11311",
    ),
    "validator": ProjectKind(
        "chain",
        "Judges whether a light was on when a robot was paid for it.",
        "The second command judges a recording by hand. `python $module.py` judges all results\n"
        f"that name this validator, for the account in `AIRA_KEYFILE`. {DEPLOY}",
        "aira validator check RECORDING --objective OBJECTIVE --checks $module.py",
    ),
}


@click.command("new")
@click.argument("kind", type=click.Choice(list(KINDS)))
@click.argument("name")
@click.option("--dir", "folder", type=PATH, help="folder to write the project to [NAME]")
@with_json
@interruptible
def command(kind: str, name: str, folder: Path | None, as_json: bool) -> None:
    """Write a project that works at once: the program, its test, and what is needed to run it on a server."""
    module = _module(name)
    target = folder or Path(name)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        hint = "choose another name, or another folder with --dir"
        raise InputError(f"{target} exists and is not empty", hint=hint, code="folder-not-empty")
    write_project(kind, name, module, target)
    then = ["pip install '.[dev]'", "pytest", Template(KINDS[kind].try_it).substitute(module=module)]
    words = "\n".join(f"    {line}" for line in (f"cd {target}", *then))
    shown = f"{target} is a new project. Go on with:\n\n{words}"
    print_result({"folder": str(target), "next": then}, shown, as_json=as_json)


def write_project(kind: str, name: str, module: str, target: Path) -> None:
    """Write the files of a project to a folder, which is made."""
    chosen = KINDS[kind]
    words = chosen._asdict() | {"name": name, "module": module, "version": version("aira-mesh")}
    words |= {"title": name.replace("-", " ").capitalize()}
    words = {key: Template(value).safe_substitute(words) for key, value in words.items() if isinstance(value, str)}
    variable, _, value = chosen.variable.partition("=")
    words["unit_variable"] = f"\nEnvironment={chosen.variable}" if variable else ""
    words["compose_variable"] = f"\n      {variable}: $" + f"{{{variable}:?as in {value}}}" if variable else ""
    words["command_list"] = "[" + ", ".join(f'"{word}"' for word in words["command"].split()) + "]"
    for source in (
        path for part in (*chosen.parts, kind) for path in sorted((TEMPLATES / part).rglob("*")) if path.is_file()
    ):
        path = target / str(source.relative_to(TEMPLATES).relative_to(source.relative_to(TEMPLATES).parts[0]))
        path = path.with_name(path.name.removesuffix(SUFFIX).replace("NAME", module))
        path.parent.mkdir(parents=True, exist_ok=True)
        text = source.read_text(encoding="utf-8")
        path.write_text(Template(text).substitute(words) if source.suffix == SUFFIX else text, encoding="utf-8")
    program = target / f"{module}.py"
    if "MODEL = " in program.read_text(encoding="utf-8"):
        (target / "model.json").write_bytes(description_from(program).encode())


def _module(name: str) -> str:
    """The name of the module of a project. Raises `InputError` for one that Python has already."""
    module = name.replace("-", "_")
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,39}", module):
        hint = "use up to 40 small letters, digits and hyphens, beginning with a letter"
        raise InputError(f"{name} can't be the name of a project", hint=hint, code="invalid-project-name")
    taken = {*sys.stdlib_module_names, *sys.builtin_module_names, *(path.stem for path in PACKAGES.iterdir())}
    if module in taken or module in ("zenoh", "twin", "test", "pytest", "click", "rich", "msgspec"):
        hint = "choose another name"
        raise InputError(f"Python has a module {module} already", hint=hint, code="invalid-project-name")
    return module
