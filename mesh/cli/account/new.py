"""`aira account new`: a fresh key."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from mesh.cli.account.keys import free_path, password_in
from mesh.cli.account.words import FILE, print_account
from mesh.cli.printing import with_json
from mesh.errors import AiraError
from mesh.running import fail

if TYPE_CHECKING:
    from pathlib import Path


@click.command("new")
@click.argument("keyfile", type=FILE)
@click.option(
    "--password-file",
    required=True,
    type=FILE,
    help="file with the password; made with a random one when it does not exist",
)
@with_json
def command(keyfile: Path, password_file: Path, as_json: bool) -> None:
    """Make an account and write its key, encrypted, to KEYFILE. Prints the address. Nothing is overwritten."""
    from mesh.chain import new_private_key, write_keyfile

    try:
        address = write_keyfile(free_path(keyfile), new_private_key(), password_in(password_file))
    except AiraError as error:
        fail(error)
    print_account(address, keyfile, as_json)
