"""`aira settings`: what is in force, and what each option means."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click
import msgspec

from mesh.cli.options import with_settings
from mesh.settings import MEANING, OPTIONS, Settings

if TYPE_CHECKING:
    from typing import Any


@click.command("settings")
@click.option("--json", "as_json", is_flag=True, help="print one JSON object")
@with_settings(*OPTIONS)
def command(settings: Settings, as_json: bool) -> None:
    """Show the settings in force, as a TOML file that can be edited and given to --config."""
    values: dict[str, Any] = msgspec.to_builtins(settings)
    if as_json:
        click.echo(msgspec.json.encode(values))
        return
    for name, value in values.items():
        click.echo(f"# {MEANING[name]}\n{name} = {msgspec.json.encode(value).decode()}\n")
