"""`aira account`: keyfiles."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mesh.amounts import ETH, XRT
from mesh.cli.chain_client import address_in_keyfile, open_chain, required_address
from mesh.cli.errors import FileExists, FileUnwritable, InvalidOptions, InvalidPrivateKey, PasswordFileUnusable
from mesh.cli.options import FILE, with_chain_settings, with_json
from mesh.cli.output import print_facts, print_json, print_line
from mesh.errors import AiraError
from mesh.running import fail, run_to_end

if TYPE_CHECKING:
    from mesh.settings import Settings


@click.group("account")
def command() -> None:
    """Create, import and show accounts: keyfiles in the Web3 secret storage format."""


@command.command("new", short_help="create an account")
@click.argument("keyfile", type=FILE)
@click.option(
    "--password-file",
    required=True,
    type=FILE,
    help="file with the password; created with a random one if missing",
)
@with_json
def new(keyfile: Path, password_file: Path, as_json: bool) -> None:
    """Create an account and write its encrypted key to KEYFILE. Prints the address. Never overwrites a file."""
    from mesh.chain import new_private_key, write_keyfile

    try:
        address = write_keyfile(free_path(keyfile), new_private_key(), password_in(password_file))
    except AiraError as error:
        fail(error)
    print_account(address, keyfile, as_json)


@command.command("import", short_help="write an existing key to a keyfile")
@click.argument("keyfile", type=FILE)
@click.option(
    "--password-file",
    required=True,
    type=FILE,
    help="file with the password of the new KEYFILE; created with a random one if missing",
)
@click.option("--private-key-file", type=FILE, help="file with the private key, 64 hexadecimal digits")
@click.option("--from-keyfile", type=FILE, help="another keyfile, from which to copy the key")
@click.option("--from-password-file", type=FILE, help="file with the password of that keyfile [prompted for]")
@with_json
def import_account(keyfile: Path, password_file: Path, as_json: bool, **source: Any) -> None:
    """Write an existing key, encrypted, to KEYFILE. Prints the address. Never overwrites a file.

    The key comes from --private-key-file or from another keyfile. Without either, it is read from standard input; a
    terminal prompts for it without echo. It is never an argument, because every user of the machine can see those.
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
    """Write the keyfile with the key from the given source; returns its address."""
    from mesh.chain import copy_keyfile, write_keyfile

    if private_key_file is not None and from_keyfile is not None:
        raise InvalidOptions("--private-key-file and --from-keyfile can't be used together")
    if from_keyfile is None:
        if from_password_file is not None:
            raise InvalidOptions("--from-password-file needs --from-keyfile")
        key = private_key_in(private_key_file)
        return write_keyfile(keyfile, key, password_in(password_file))
    opened_by, where = password_of(from_keyfile, from_password_file)
    password = password_in(password_file)
    return copy_keyfile(from_keyfile, keyfile, opened_by=opened_by, password=password, password_from=where)


def _check_no_key(keyfile: Path) -> None:
    """Raise `InvalidPrivateKey` if the file's name is a private key."""
    digits = keyfile.name.removeprefix("0x")
    if len(digits) == 64 and not digits.strip("0123456789abcdefABCDEF"):
        raise InvalidPrivateKey(
            "the keyfile's name looks like a private key",
            hint="your shell's history may contain this key now, so use a new one, and give it on standard input",
        )


@command.command("show", short_help="show an account's address and balances")
@click.argument("file", metavar="[KEYFILE]", required=False, type=FILE)
@click.option("--balance", is_flag=True, help="also show its ETH, its XRT and its next order nonce, from the chain")
@with_json
@with_chain_settings()
def show(settings: Settings, file: Path | None, balance: bool, as_json: bool) -> None:
    """Print the address of the account in KEYFILE (by default the keyfile in the settings). Needs no password."""
    try:
        address = required_address(settings) if file is None else address_in_keyfile(file)
    except AiraError as error:
        fail(error)
    if balance:
        run_to_end(lambda: _show_balance(settings, address, as_json))
    else:
        print_account(address, file or Path(settings.keyfile), as_json)


async def _show_balance(settings: Settings, address: str, as_json: bool) -> None:
    from mesh.chain import NotOffered

    async with open_chain(settings) as chain:
        wei, wn = await chain.tokens.eth_balance(address), await chain.tokens.balance(address)
        try:
            nonce = await chain.liabilities.next_nonce(address)
        except NotOffered:
            nonce = None
    if as_json:
        print_json({"address": address, "wei": str(wei), "wn": str(wn), "nonce": nonce})
    else:
        facts: dict[str, Any] = {
            "address": address,
            "ETH": ETH.number(wei),
            "XRT": XRT.number(wn),
            "order nonce": nonce,
        }
        print_facts(facts)


def print_account(address: str, keyfile: Path, as_json: bool) -> None:
    """Print an account's address, in JSON with its keyfile."""
    if as_json:
        print_json({"address": address, "keyfile": str(keyfile)})
    else:
        print_line(address)


KEY_DIGITS = 64


def free_path(keyfile: Path) -> Path:
    """Return the path after creating its folder. Raises `FileExists`, `FileUnwritable`."""
    if keyfile.exists():
        raise FileExists(f"{keyfile} already exists", hint="keyfiles are never overwritten; choose another name")
    try:
        keyfile.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileUnwritable(f"can't create the folder of {keyfile}: {error.strerror}") from None
    return keyfile


def password_in(path: Path) -> str:
    """The password in a file: its first line. A missing file is created with a random one, for its owner only."""
    import secrets

    try:
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
                file.write(secrets.token_urlsafe(24) + "\n")
    except OSError as error:
        raise PasswordFileUnusable(f"can't use the password file {path}: {error.strerror}") from None
    password = _first_line(path, what="password file")
    if not password:
        raise PasswordFileUnusable(f"the password file {path} is empty", hint="write the password to its first line")
    return password


def private_key_in(path: Path | None) -> bytes:
    """The private key in a file; without a file, from standard input or a terminal prompt without echo.

    Raises `InvalidPrivateKey`, which never shows the text, and `PasswordFileUnusable` for a file that can't be read.
    """
    if path is None:
        text, where = _asked("private key: "), "the input"
    else:
        text, where = _first_line(path, what="private key"), f"the first line of {path}"
    digits = text.strip().removeprefix("0x")
    try:
        key = bytes.fromhex(digits)
    except ValueError:  # its message would show a part of the key
        key = b""
    if len(digits) != KEY_DIGITS or len(key) != KEY_DIGITS // 2:
        raise InvalidPrivateKey(
            f"{where} is not a private key",
            hint="a private key has 64 hexadecimal digits, with or without the prefix 0x",
        )
    return key


def password_of(keyfile: Path, path: Path | None) -> tuple[str, str]:
    """The password of a keyfile, and its source: a file, standard input or a terminal."""
    if path is not None:
        return _first_line(path, what="password file"), str(path)
    return _asked(f"password of {keyfile}: "), "the answer"


def _asked(question: str) -> str:
    """A line of standard input. A terminal prompts for it without echo."""
    import getpass

    try:
        line = getpass.getpass(question) if sys.stdin.isatty() else sys.stdin.readline()
    except (EOFError, UnicodeDecodeError):
        line = ""
    line = line.rstrip("\r\n")
    if not line:
        raise InvalidPrivateKey(f"the {question.removesuffix(': ')} is empty", hint="enter one line on standard input")
    return line


def _first_line(path: Path, *, what: str) -> str:
    """The first line of a file. Raises `PasswordFileUnusable`, which shows no part of the file."""
    try:
        return path.read_text(encoding="utf-8").split("\n", 1)[0].rstrip("\r")
    except OSError as error:
        raise PasswordFileUnusable(f"can't use the {what} {path}: {error.strerror}") from None
    except UnicodeDecodeError:  # its message would show a part of the secret
        raise PasswordFileUnusable(f"can't use the {what} {path}: it is not UTF-8 text") from None
