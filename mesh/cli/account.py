"""`aira account`: keyfiles."""

from __future__ import annotations

import os
from pathlib import Path

import click

from mesh.errors import AiraError, ConfigurationError
from mesh.running import fail


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
        click.echo(write_keyfile(_free(keyfile), new_private_key(), _password(password_file)))
    except AiraError as error:
        fail(error)


@command.command("show")
@click.argument("keyfile", type=click.Path(dir_okay=False, path_type=Path))
def show(keyfile: Path) -> None:
    """Print the address of the account in KEYFILE; needs no password."""
    from mesh.chain import keyfile_address

    try:
        address = keyfile_address(keyfile)
        if address is None:
            raise ConfigurationError(f"{keyfile} does not say its address", hint="some keyfiles keep it to themselves")
    except AiraError as error:
        fail(error)
    click.echo(address)


def _free(keyfile: Path) -> Path:
    """The same path, its folder made. A name that is taken is found before a password is made for it."""
    if keyfile.exists():
        raise ConfigurationError(f"{keyfile} exists already", hint="no keyfile is overwritten; choose another name")
    try:
        keyfile.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"can't make the folder of {keyfile}: {error.strerror}") from None
    return keyfile


def _password(path: Path) -> str:
    """The password in a file, its first line; the file is made, readable by its owner only, when it is missing."""
    import secrets

    try:
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
                file.write(secrets.token_urlsafe(24) + "\n")
        password = path.read_text(encoding="utf-8").split("\n", 1)[0].rstrip("\r")
    except OSError as error:
        raise ConfigurationError(f"can't use the password file {path}: {error.strerror}") from None
    except UnicodeDecodeError:  # whose own text shows a part of the password
        raise ConfigurationError(f"can't use the password file {path}: it is not UTF-8 text") from None
    if not password:
        raise ConfigurationError(f"the password file {path} is empty", hint="write one line with the password into it")
    return password
