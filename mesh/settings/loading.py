"""Loading settings: one TOML file, then `AIRA_*` variables, then flags; the later wins."""

from __future__ import annotations

import logging
import os
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from mesh.errors import ConfigurationError
from mesh.log_context import log_event
from mesh.settings.groups import DEFAULTS, MEANING, OPTIONS, Settings
from mesh.suggestions import nearest

if TYPE_CHECKING:
    from collections.abc import Mapping

log = logging.getLogger(__name__)

PREFIX: Final = "AIRA_"
RETIRED: Final = {
    "master_check_interval": "there is no ROS master; delete the option",
}
"""Options of the legacy stack that have no meaning here, and why. They are logged and ignored."""

NOT_OPTIONS: Final = frozenset(
    {
        "AIRA_CONFIG",
        *("AIRA_REQUIRE_PEERS", "AIRA_PEERS_CACHE", "AIRA_KUBO", "AIRA_MCAP", "AIRA_ORIGINAL_CONTRACTS"),
        *("AIRA_MODEL_HISTORIES", "AIRA_MONEY_HISTORIES", "AIRA_TURN_HISTORIES", "AIRA_SIMULATION_TRACEBACKS"),
    }
)
"""`AIRA_*` variables that belong to the command line or to the tests, not to the settings."""


class UnknownOption(ConfigurationError, code="unknown-option"):
    """A file, the environment or the flags (`where`) set an option that does not exist; `nearest` is a similar one."""

    def __init__(self, name: str, where: str, similar: str | None) -> None:
        hint = f"did you mean {similar!r}?" if similar else "`aira settings` lists the options"
        super().__init__(f"unknown option {name!r} in {where}", hint=hint)
        self.name = name
        self.where = where
        self.nearest = similar


class InvalidOption(ConfigurationError, code="invalid-option"):
    """The value of the option `name` has the wrong type or is out of range."""

    def __init__(self, name: str, why: str) -> None:
        super().__init__(f"the setting {name} is invalid: {why}", hint=f"{name}: {MEANING[name]}")
        self.name = name


class SettingsUnreadable(ConfigurationError, code="settings-unreadable"):
    """The settings file at `path` can't be read."""

    def __init__(self, path: Path, why: str | None) -> None:
        super().__init__(f"can't read the settings {path}: {why}")
        self.path = path


class SettingsNotToml(ConfigurationError, code="settings-not-toml"):
    """The settings file at `path` is not TOML."""

    def __init__(self, path: Path, why: object) -> None:
        super().__init__(f"{path} is not TOML: {why}")
        self.path = path


def load(
    *, path: Path | None = None, environ: Mapping[str, str] | None = None, flags: Mapping[str, Any] | None = None
) -> Settings:
    """The settings from the file at `path`, the `AIRA_*` variables of `environ` and `flags`.

    Without a path, `AIRA_CONFIG` names the file, if it is set. A flag whose value is None was not given.
    Raises `SettingsUnreadable`, `SettingsNotToml`, `UnknownOption` or `InvalidOption`.
    """
    variables = os.environ if environ is None else environ
    if path is None and variables.get("AIRA_CONFIG"):
        path = Path(variables["AIRA_CONFIG"])
    merged: dict[str, Any] = {}
    if path is not None:
        merged |= _checked(_read_toml(path), where=str(path))
    merged |= _checked(_from_environment(variables), where="the environment")
    given = {name: value for name, value in (flags or {}).items() if value is not None}
    merged |= _checked(given, where="the flags")
    try:
        return msgspec.convert(merged, Settings, strict=False)
    except msgspec.ValidationError as error:
        raise _invalid(error) from None


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SettingsUnreadable(path, error.strerror) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsNotToml(path, error) from None


def _from_environment(environ: Mapping[str, str]) -> dict[str, Any]:
    """The options among the variables; lists are split by commas."""
    found: dict[str, Any] = {}
    for variable, text in environ.items():
        if variable.startswith(PREFIX) and variable not in NOT_OPTIONS:
            name = variable.removeprefix(PREFIX).lower()
            found[name] = _split(text) if isinstance(getattr(DEFAULTS, name, None), tuple) else text
    return found


def _split(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(",") if part.strip())


def _checked(options: dict[str, Any], *, where: str) -> dict[str, Any]:
    """The options without the retired ones. Raises `UnknownOption`."""
    kept: dict[str, Any] = {}
    for name, value in options.items():
        if name in RETIRED:
            log.warning(
                "%s in %s has no effect: %s", name, where, RETIRED[name], extra=log_event("option-retired", option=name)
            )
        elif name in OPTIONS:
            kept[name] = value
        else:
            raise UnknownOption(name, where, nearest(name, OPTIONS))
    return kept


def _invalid(error: msgspec.ValidationError) -> InvalidOption:
    """The error with the option's name in front, which msgspec puts as a path at the end."""
    why, _, path = str(error).partition(" - at `$.")
    name = path.rstrip("`").partition("[")[0]
    return InvalidOption(name, why)
