"""`aira account`: keyfiles."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from msgspec import to_builtins

from mesh.amounts import ETH, XRT
from mesh.base.private_files import write_new
from mesh.cli.chain_client import address_in_keyfile, open_chain, required_address
from mesh.cli.options import FILE, with_chain_settings, with_json, with_settings, with_timeout
from mesh.cli.output import plural, print_result
from mesh.errors import ConfigurationError, InputError
from mesh.role.running import run_to_end
from mesh.settings import AccountSettings, ChainSettings, NetworkSettings
from schemas.decoding import InvalidData, first_line, text_of

if TYPE_CHECKING:
    from mesh.ops.rotation import Rotated, RotationPlan
    from mesh.settings import Settings


@click.group("account")
def command() -> None:
    """Create, import and show accounts: keyfiles in the Web3 secret storage format."""


@command.command("new", short_help="create an account")
@click.argument("keyfile", type=FILE)
@click.option(
    "--password-file", required=True, type=FILE, help="file with the password; created with a random one if missing"
)
@with_json
def new(keyfile: Path, password_file: Path, as_json: bool) -> None:
    """Create an account and write its encrypted key to KEYFILE. Prints the address. Never overwrites a file."""
    from mesh.chain import new_private_key, write_keyfile

    address = write_keyfile(free_path(keyfile), new_private_key(), password_in(password_file))
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
def import_account(
    keyfile: Path,
    password_file: Path,
    private_key_file: Path | None,
    from_keyfile: Path | None,
    from_password_file: Path | None,
    as_json: bool,
) -> None:
    """Write an existing key, encrypted, to KEYFILE. Prints the address. Never overwrites a file.

    The key comes from --private-key-file or from another keyfile. Without either, it is read from standard input; a
    terminal prompts for it without echo. It is never an argument, because every user of the machine can see those.
    """
    from mesh.chain import copy_keyfile, write_keyfile

    digits = keyfile.name.removeprefix("0x")
    if len(digits) == 64 and not digits.strip("0123456789abcdefABCDEF"):
        raise InputError(
            "the keyfile's name looks like a private key",
            hint="your shell's history may contain this key now, so use a new one, and give it on standard input",
            code="invalid-private-key",
        )
    free_path(keyfile)
    if private_key_file is not None and from_keyfile is not None:
        raise InputError("--private-key-file and --from-keyfile can't be used together", code="invalid-options")
    if from_keyfile is None:
        if from_password_file is not None:
            raise InputError("--from-password-file needs --from-keyfile", code="invalid-options")
        key = private_key_in(private_key_file)
        address = write_keyfile(keyfile, key, password_in(password_file))
    else:
        if from_password_file is not None:
            opened_by, where = _first_line(from_password_file, what="password file"), str(from_password_file)
        else:
            opened_by, where = _asked(f"password of {from_keyfile}: "), "the answer"
        password = password_in(password_file)
        address = copy_keyfile(from_keyfile, keyfile, opened_by=opened_by, password=password, password_from=where)
    print_account(address, keyfile, as_json)


@command.command("show", short_help="show an account's address and balances")
@click.argument("file", metavar="[KEYFILE]", required=False, type=FILE)
@click.option("--password-file", type=FILE, help="file with KEYFILE's password, to check its address [the settings']")
@click.option("--balance", is_flag=True, help="also show its ETH, its XRT and its next order nonce, from the chain")
@with_json
@with_chain_settings()
def show(settings: Settings, file: Path | None, password_file: Path | None, balance: bool, as_json: bool) -> None:
    """Print the address of the account in KEYFILE (by default the keyfile in the settings).

    Without a password, that is what the file says; with one, the key is checked to have this address.
    """
    address = required_address(settings) if file is None else address_in_keyfile(file)
    _check_address(settings, file or Path(settings.keyfile).expanduser(), password_file)
    if balance:
        run_to_end(lambda: _show_balance(settings, address, as_json))
    else:
        print_account(address, file or Path(settings.keyfile), as_json)


@command.command("rotate", short_help="give a robot or a provider a new key")
@click.option("--dry-run", is_flag=True, help="only show what would be done")
@with_timeout(None, meaning="seconds to wait for contracts and providers [no limit]")
@with_json
@with_settings(NetworkSettings, "lighthouse_contract", AccountSettings, ChainSettings)
async def rotate(settings: Settings, dry_run: bool, timeout: float | None, as_json: bool) -> None:
    """Move the robot or the provider of the settings to a new key, which takes the place of the old one in its keyfile.

    The robot takes no new jobs, its open orders are withdrawn on the chain, and its contracts end: let it run
    meanwhile. Both keys sign that this is the same robot, the new keyfile takes its place, and the tokens, the coin and
    the stake at the lighthouse move. The old keyfile stays beside the new one, and no role uses it any more. Start the
    robot again after that.

    Let a provider run, too: the command says when to start a second one, which has the new key, and when to stop the
    first. Without the XRT for two stakes stop it before, and start it again after that.

    If it is interrupted, repeat the command: it goes on where it stopped.
    """
    from mesh.ops.rotation import Rotation

    rotation = Rotation(settings, report=lambda line: click.echo(line, err=True))
    if dry_run:
        plan = await rotation.plan()
        names = {token: await _shown(settings, token, amount) for token, amount in plan.tokens.items()}
        facts = {
            "old address": plan.old,
            "withdraws": plural(plan.orders, "open order"),
            "waits for": plural(plan.contracts, "contract"),
            "moves the stake": XRT.show(plan.stake) if plan.stake else None,
            "lacks for two stakes": XRT.show(plan.missing) if plan.missing else None,
            "moves": ", ".join([*names.values(), f"{ETH.show(plan.coin)}, less the price of its transactions"]),
        }
        print_result(_in_texts(plan), facts, as_json=as_json)
        return
    done = await rotation.run(timeout=timeout)
    facts = {
        "old address": done.old,
        "new address": done.new,
        "keyfile": done.keyfile,
        "old keyfile": done.retired,
        "left behind": ETH.show(done.left) if done.left else None,
        "now": "start the robot or the provider, unless it runs under the new key",
    }
    print_result(_in_texts(done), facts, as_json=as_json)


def _in_texts(rotation: Rotated | RotationPlan) -> dict[str, Any]:
    """For JSON: amounts are text, in the smallest units."""
    facts: dict[str, Any] = to_builtins(rotation)
    facts["tokens"] = {token: str(amount) for token, amount in rotation.tokens.items()}
    return facts | {name: str(facts[name]) for name in ("stake", "missing", "coin", "left") if name in facts}


async def _shown(settings: Settings, token: str, amount: int) -> str:
    async with open_chain(settings) as chain:
        return (await chain.tokens.unit(token)).show(amount)


def _check_address(settings: Settings, keyfile: Path, password_file: Path | None) -> None:
    """Raise `KeyfileError` (`keyfile-address-wrong`) if a keyfile does not have the key of the address that it states.

    The settings' password may be of another keyfile, or not readable here: then nothing is checked.
    """
    from mesh.base.extras import PackageMissing
    from mesh.chain import Account, KeyfileError

    configured = Path(settings.keyfile_password_file).expanduser()
    if password_file is not None:
        Account.from_keyfile(keyfile, password_file)
    elif settings.keyfile_password_file and os.access(configured, os.R_OK):
        try:
            Account.from_keyfile(keyfile, configured)
        except PackageMissing:
            pass
        except KeyfileError as error:
            if error.code != "wrong-password":
                raise


async def _show_balance(settings: Settings, address: str, as_json: bool) -> None:
    from mesh.chain import NotOffered

    async with open_chain(settings) as chain:
        wei, wn = await chain.tokens.eth_balance(address), await chain.tokens.balance(address)
        try:
            nonce = await chain.liabilities.next_nonce(address)
        except NotOffered:
            nonce = None
    result = {"address": address, "wei": str(wei), "wn": str(wn), "nonce": nonce}
    facts = {"address": address, "ETH": ETH.number(wei), "XRT": XRT.number(wn), "order nonce": nonce}
    print_result(result, facts, as_json=as_json)


def print_account(address: str, keyfile: Path, as_json: bool) -> None:
    """Print an account's address, in JSON with its keyfile."""
    print_result({"address": address, "keyfile": str(keyfile)}, address, as_json=as_json)


def free_path(keyfile: Path) -> Path:
    """Return the path after creating its folder. Raises `InputError`, `ConfigurationError`."""
    if keyfile.exists():
        raise InputError(
            f"{keyfile} already exists", hint="keyfiles are never overwritten; choose another name", code="file-exists"
        )
    try:
        keyfile.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(
            f"can't create the folder of {keyfile}: {error.strerror}", code="file-unwritable"
        ) from None
    return keyfile


def password_in(path: Path) -> str:
    """The password in a file: its first line. A missing file is created with a random one, for its owner only."""
    import secrets

    try:
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_new(path, f"{secrets.token_urlsafe(24)}\n".encode())
    except OSError as error:
        raise ConfigurationError(
            f"can't use the password file {path}: {error.strerror}", code="password-file-unusable"
        ) from None
    password = _first_line(path, what="password file")
    if not password:
        raise ConfigurationError(
            f"the password file {path} is empty",
            hint="write the password to its first line",
            code="password-file-unusable",
        )
    return password


def private_key_in(path: Path | None) -> bytes:
    """The private key in a file; without a file, from standard input or a terminal prompt without echo.

    Raises `InputError`, which never shows the text, and `ConfigurationError` for a file that can't be read.
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
    if len(digits) != 64 or len(key) != 32:
        raise InputError(
            f"{where} is not a private key",
            hint="a private key has 64 hexadecimal digits, with or without the prefix 0x",
            code="invalid-private-key",
        )
    return key


def _asked(question: str) -> str:
    """A line of standard input. A terminal prompts for it without echo."""
    import getpass

    try:
        line = getpass.getpass(question) if sys.stdin.isatty() else text_of(first_line(sys.stdin.buffer.readline()))
    except EOFError:
        line = ""
    if not line:
        raise InputError(
            f"the {question.removesuffix(': ')} is empty",
            hint="enter one line on standard input",
            code="invalid-private-key",
        )
    return line


def _first_line(path: Path, *, what: str) -> str:
    """The first line of a file. Raises `ConfigurationError`, which shows no part of the file."""
    try:
        return text_of(first_line(path.read_bytes()))
    except OSError as error:
        raise ConfigurationError(
            f"can't use the {what} {path}: {error.strerror}", code="password-file-unusable"
        ) from None
    except InvalidData as error:
        raise ConfigurationError(
            f"can't use the {what} {path}: {error}", hint=error.hint, code="password-file-unusable"
        ) from None
