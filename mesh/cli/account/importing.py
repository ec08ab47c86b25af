"""`aira account import`: a key that there is already."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from mesh.cli.account.keys import free_path, password_in, password_of, private_key_in
from mesh.cli.account.words import FILE, print_account
from mesh.cli.printing import with_json
from mesh.errors import AiraError, InputError
from mesh.running import fail

if TYPE_CHECKING:
    from pathlib import Path


@click.command("import")
@click.argument("keyfile", type=FILE)
@click.option(
    "--password-file",
    required=True,
    type=FILE,
    help="file with the password of the new KEYFILE; made with a random one when it does not exist",
)
@click.option("--private-key-file", type=FILE, help="file with the private key, 64 hexadecimal digits")
@click.option("--from-keyfile", type=FILE, help="another keyfile, whose key is to be taken")
@click.option("--from-password-file", type=FILE, help="file with the password of that one [it is asked for]")
@with_json
def command(keyfile: Path, password_file: Path, as_json: bool, **source: Any) -> None:
    """Write a key that there is already, encrypted, to KEYFILE. Prints the address. Nothing is overwritten.

    The key comes from --private-key-file, or from another keyfile. With neither, it is read from the standard input, or
    asked for on a terminal without being shown. It is never an argument: those are seen by everybody on the machine.
    """
    try:
        _check_no_key(keyfile)
        address = _import(free_path(keyfile), password_file, **source)
    except AiraError as error:
        fail(error)
    print_account(address, keyfile, as_json)


def _import(
    keyfile: Path,
    password_file: Path,
    *,
    private_key_file: Path | None,
    from_keyfile: Path | None,
    from_password_file: Path | None,
) -> str:
    """Write the keyfile from one of the sources of a key; its address. Raises `InputError`, `ConfigurationError`."""
    from mesh.chain import copy_keyfile, write_keyfile

    if private_key_file is not None and from_keyfile is not None:
        raise InputError("a key comes from --private-key-file or from --from-keyfile, not from both")
    if from_keyfile is None:
        if from_password_file is not None:
            raise InputError("--from-password-file goes with --from-keyfile")
        key = private_key_in(private_key_file)
        return write_keyfile(keyfile, key, password_in(password_file))
    opened_by, where = password_of(from_keyfile, from_password_file)
    password = password_in(password_file)
    return copy_keyfile(from_keyfile, keyfile, opened_by=opened_by, password=password, password_from=where)


def _check_no_key(keyfile: Path) -> None:
    """Raise `InputError` for a private key in the place of a file's name."""
    digits = keyfile.name.removeprefix("0x")
    if len(digits) == 64 and not digits.strip("0123456789abcdefABCDEF"):
        raise InputError(
            "that looks like a private key, and is no name for a keyfile",
            hint="give it on the standard input; it is in your shell's history now, so better take a new one",
        )
