"""`aira account`: keyfiles."""

from __future__ import annotations

import os
from pathlib import Path

import click

from mesh.cli.running import fail
from mesh.errors import AiraError, ConfigurationError


@click.group("account")
def command() -> None:
    """Make and look at accounts: keyfiles in the Web3 secret storage format."""


@command.command("new")
@click.argument("keyfile", type=click.Path(dir_okay=False, path_type=Path))
@click.option(
    "--password-file",
    required=True,
    type=click.Path(dir_okay=False, path_type=Path),
    help="file with the password; made with a random one when it does not exist",
)
def new(keyfile: Path, password_file: Path) -> None:
    """Make an account and write its key, encrypted, to KEYFILE. Prints the address. Nothing is overwritten."""
    from mesh.chain import new_private_key, write_keyfile

    try:
        click.echo(write_keyfile(keyfile, new_private_key(), _password(password_file)))
    except AiraError as error:
        fail(error)


@command.command("show")
@click.argument("keyfile", type=click.Path(dir_okay=False, path_type=Path))
def show(keyfile: Path) -> None:
    """Print the address of the account in KEYFILE; needs no password."""
    from mesh.chain import keyfile_address

    try:
        click.echo(keyfile_address(keyfile))
    except AiraError as error:
        fail(error)


def _password(path: Path) -> str:
    """The password in a file, which is made, readable by its owner only, when it is missing."""
    import secrets

    try:
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
                file.write(secrets.token_urlsafe(24) + "\n")
        return path.read_text(encoding="utf-8").rstrip("\r\n")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"can't use the password file {path}: {error}") from None
