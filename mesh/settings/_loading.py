"""Loading settings: one TOML file, then `AIRA_*` variables, then flags; the later wins."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from mesh.base.log_context import log_event
from mesh.base.suggestions import nearest
from mesh.errors import ConfigurationError
from mesh.settings.groups import DEFAULTS, MEANING, OPTIONS, Settings
from schemas.decoding import InvalidData, decode_toml, text_of

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
        *("AIRA_REQUIRE_PEERS", "AIRA_PEERS_CACHE", "AIRA_MCAP", "AIRA_ORIGINAL_CONTRACTS"),
        *("AIRA_MODEL_HISTORIES", "AIRA_MONEY_HISTORIES", "AIRA_TURN_HISTORIES", "AIRA_SIMULATION_TRACEBACKS"),
    }
)
"""`AIRA_*` variables that belong to the command line or to the tests, not to the settings."""


def load(
    *, path: Path | None = None, environ: Mapping[str, str] | None = None, flags: Mapping[str, Any] | None = None
) -> Settings:
    """The settings from the file at `path`, the `AIRA_*` variables of `environ` and `flags`.

    Without a path, `AIRA_CONFIG` names the file, if it is set. A flag whose value is None was not given.
    Raises `ConfigurationError`.
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
        why, _, place = str(error).partition(" - at `$.")
        name = place.rstrip("`").partition("[")[0]
        hint = f"{name}: {MEANING[name]}"
        raise ConfigurationError(f"the setting {name} is invalid: {why}", hint=hint, code="invalid-option") from None


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return decode_toml(text_of(path.read_bytes()))
    except OSError as error:
        raise ConfigurationError(
            f"can't read the settings {path}: {error.strerror}", code="settings-unreadable"
        ) from None
    except InvalidData as error:
        raise ConfigurationError(f"{path} is not TOML: {error}", code="settings-not-toml") from None


def _from_environment(environ: Mapping[str, str]) -> dict[str, Any]:
    """The options among the variables; lists are split by commas."""
    found: dict[str, Any] = {}
    for variable, text in environ.items():
        if variable.startswith(PREFIX) and variable not in NOT_OPTIONS:
            name = variable.removeprefix(PREFIX).lower()
            is_list = isinstance(getattr(DEFAULTS, name, None), tuple)
            found[name] = tuple(part.strip() for part in text.split(",") if part.strip()) if is_list else text
    return found


def _checked(options: dict[str, Any], *, where: str) -> dict[str, Any]:
    """The options without the retired ones. Raises `ConfigurationError`."""
    kept: dict[str, Any] = {}
    for name, value in options.items():
        if name in RETIRED:
            log.warning(
                "%s in %s has no effect: %s", name, where, RETIRED[name], extra=log_event("option-retired", option=name)
            )
        elif name in OPTIONS:
            kept[name] = value
        else:
            near = nearest(name, OPTIONS)
            hint = f"did you mean {near!r}?" if near else "`aira settings` lists the options"
            raise ConfigurationError(f"unknown option {name!r} in {where}", hint=hint, code="unknown-option")
    return kept
