"""`aira settings`: shows the effective settings and the meaning of each option."""

from __future__ import annotations

import click
import msgspec

from mesh.cli.options import with_settings
from mesh.settings import MEANING, OPTIONS, Settings
from mesh.settings.chains import FILLED


@click.command("settings")
@click.option("--json", "as_json", is_flag=True, help="print one JSON object")
@with_settings(*OPTIONS)
def command(settings: Settings, as_json: bool) -> None:
    """Print the effective settings as a TOML file, which you can edit and pass to --config."""
    values = {name: getattr(settings, name) for name in OPTIONS}
    if as_json:
        click.echo(msgspec.json.encode(values))
        return
    for name, value in values.items():
        # What is the chain's is not given, so that it is the other's when another chain is named in the file.
        given = "" if name not in FILLED or value != getattr(settings.profile, name) else "# "
        click.echo(f"# {MEANING[name]}\n{given}{name} = {msgspec.json.encode(value).decode()}\n")
