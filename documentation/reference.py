"""The pages of the reference that are made from the source, none of which is kept in the repository."""

from __future__ import annotations

import re
from dataclasses import fields
from importlib import import_module
from inspect import cleandoc, isclass, isfunction
from pathlib import Path
from types import ModuleType, NoneType, UnionType
from typing import TYPE_CHECKING, Any, Final, Literal, Union, get_args, get_origin, get_type_hints

import msgspec

from documentation.commands import command_pages
from documentation.http import http_api
from documentation.markdown import escaped
from documentation.metrics import metrics
from documentation.performance import performance
from mesh.settings import MEANING, Settings
from schemas import keys
from schemas.errors import AiraError
from schemas.messages import MESSAGE_TYPES

if TYPE_CHECKING:
    from collections.abc import Iterator

PUBLIC: Final = ("mesh", "mesh.testing", "bridges.serial", "bridges.ros1", "bridges.ros2")
"""The packages that users import from."""
PAGES: Final = {
    "mesh.testing": ("testing", "Tests"),
    "mesh.agent.validators": ("validators", "Validators"),
    "mesh.validator": ("validators", "Validators"),
    "schemas.verdicts": ("validators", "Validators"),
    "mesh.agent": ("agents", "Agents, orders and jobs"),
    "mesh.role": ("agents", "Agents, orders and jobs"),
    "mesh.network": ("agents", "Agents, orders and jobs"),
    "mesh.watching": ("agents", "Agents, orders and jobs"),
    "schemas.rpc": ("agents", "Agents, orders and jobs"),
    "mesh.recording": ("recordings", "Objectives and recordings"),
    "schemas.payloads": ("recordings", "Objectives and recordings"),
    "schemas.unixfs": ("recordings", "Objectives and recordings"),
    "schemas.model": ("models", "Models"),
    "schemas": ("messages", "Messages"),
    "mesh.amounts": ("messages", "Messages"),
    "mesh.settings": ("settings", "Settings of a program"),
    "bridges.serial": ("devices", "Devices"),
    "bridges.ros1": ("ros1", "ROS 1"),
    "bridges.ros2": ("ros2", "ROS 2"),
}
"""Where names are described: the first entry whose module or package defines them. Errors have a page of their own."""
ERRORS: Final = ("errors", "Errors")


def reference() -> dict[str, str]:
    """The text of each page, by its place in the site."""
    made = {f"commands/{name}": text for name, text in command_pages().items()}
    made |= {f"api/{name}": text for name, text in _python().items()}
    made |= {
        "http.md": http_api(),
        "keyspace.md": _keys(),
        "metrics.md": metrics(),
        "settings.md": _settings(),
    }
    return {"explanation/performance.md": performance(), **{f"reference/{name}": text for name, text in made.items()}}


def _python() -> dict[str, str]:
    """The pages of the Python interface: each public name, for mkdocstrings, which reads its docstrings."""
    pages: dict[tuple[str, str], dict[str, str]] = {}
    packages: dict[str, set[str]] = {}
    for package in PUBLIC:
        module = import_module(package)
        for name in sorted(name for name in module.__all__ if not name.startswith("__")):
            value = getattr(module, name)
            home = home_of(package, name)
            page = _page_of(package, value, home)
            pages.setdefault(page, {})[name] = home if isinstance(value, ModuleType) else f"{home}.{name}"
            packages.setdefault(page[0], set()).add(f"`{package}`")
    made = {
        f"{page}.md": f"# {title}\n\nImport these names from {' and '.join(sorted(packages[page]))}.\n\n"
        + "\n".join(f"::: {home}\n" for home in names.values())
        for (page, title), names in pages.items()
    }
    rows = (
        f"| [{title}]({page}.md) | {', '.join(f'`{name}`' for name in names)} |\n"
        for (page, title), names in pages.items()
    )
    return {"index.md": f"# Python\n\nWhat programs import.\n\n| page | names |\n|---|---|\n{''.join(rows)}", **made}


def _page_of(package: str, value: object, home: str) -> tuple[str, str]:
    if package == "mesh" and isclass(value) and issubclass(value, AiraError):
        return ERRORS
    place = package if package in PAGES else home
    return next(page for prefix, page in PAGES.items() if f"{place}.".startswith(f"{prefix}."))


def home_of(package: str, name: str) -> str:
    """The module that defines a public name, found by the imports of the packages that pass it on."""
    value = getattr(import_module(package), name)
    if isinstance(value, ModuleType):
        return value.__name__
    if isclass(value) or isfunction(value):
        return str(value.__module__)
    module = import_module(package)
    folder = Path(str(module.__file__))
    stub = folder.with_name("__init__.pyi")
    text = (stub if folder.name == "__init__.py" and stub.exists() else folder).read_text(encoding="utf-8")
    for found in re.finditer(r"^from (\S+) import (?:\(([^)]*)\)|(.*))$", text, re.MULTILINE):
        if re.search(rf"\b{name}\b", found[2] or found[3]):
            return home_of(found[1], name)
    return package


def _settings() -> str:
    """The page of the settings: each group with its options."""
    text = (
        "# Settings\n\nA settings file (TOML) has the names below; `--config FILE` or `AIRA_CONFIG` names it. Variables"
        " override the file, and flags override both. `aira settings` prints what is in effect. An option that does not"
        " exist is refused.\n"
    )
    hints = get_type_hints(Settings)
    seen: set[str] = set()
    for group in reversed(Settings.__mro__[1:-1]):
        own = [each for each in fields(group) if each.name not in seen]
        seen |= {each.name for each in own}
        text += f"\n## {(group.__doc__ or '').strip().removesuffix('.')}\n" if own else ""
        for option in own:
            default = msgspec.json.encode(option.default).decode()
            flag = f"--{option.name.replace('_', '-')}"
            text += (
                f"\n### `{option.name}` {{ #{option.name} }}\n\n{escaped(_sentence(MEANING[option.name]))}\n\n"
                f"`AIRA_{option.name.upper()}`, `{flag}`; {_kind(hints[option.name])}, by default `{default}`\n"
            )
    return text


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _kind(hint: Any) -> str:
    if get_origin(hint) is tuple:
        return "a list of texts"
    if get_origin(hint) is Literal:
        return "one of " + ", ".join(f"`{one}`" for one in get_args(hint))
    if get_origin(hint) in (Union, UnionType):
        return " or ".join(_kind(one) for one in get_args(hint) if one is not NoneType)
    return {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}[hint]


def _keys() -> str:
    """The page of the keyspace and of the messages on it."""
    about = cleandoc(keys.__doc__ or "").partition("\n\n")[0]
    text = f"# Keyspace and messages of a market\n\n{about}\n\n| key | what is on it |\n|---|---|\n"
    text += "".join(
        f"| <code>{key.pattern.replace('/', '/<wbr>')}</code> | {escaped(_first(key))} |\n" for key in _key_classes()
    )
    text += "\n## Messages\n\nThe JSON objects that travel on a market's keys.\n"
    for kind in MESSAGE_TYPES:
        text += f"\n### {kind.__name__}\n\n{escaped(_first(kind))}\n\n| field | type |\n|---|---|\n"
        hints = get_type_hints(kind)
        text += "".join(f"| `{one.encode_name}` | {_kind(hints[one.name])} |\n" for one in msgspec.structs.fields(kind))
    return text


def _key_classes() -> Iterator[type[keys.BaseKey]]:
    for value in vars(keys).values():
        if isclass(value) and issubclass(value, keys.BaseKey) and "pattern" in vars(value):
            yield value


def _first(kind: type) -> str:
    return " ".join(cleandoc(kind.__doc__ or "").split())
