"""Keys and passwords on their way in: from files, the standard input or a terminal; never shown, never in an error."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

from mesh.errors import ConfigurationError, InputError

if TYPE_CHECKING:
    from pathlib import Path

KEY_DIGITS = 64


def free_path(keyfile: Path) -> Path:
    """The same path, its folder made. Raises `ConfigurationError` for a name that is taken."""
    if keyfile.exists():
        raise ConfigurationError(f"{keyfile} exists already", hint="no keyfile is overwritten; choose another name")
    try:
        keyfile.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"can't make the folder of {keyfile}: {error.strerror}") from None
    return keyfile


def password_in(path: Path) -> str:
    """The password in a file, its first line; the file is made, readable by its owner only, when it is missing."""
    import secrets

    try:
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
                file.write(secrets.token_urlsafe(24) + "\n")
    except OSError as error:
        raise ConfigurationError(f"can't use the password file {path}: {error.strerror}") from None
    password = _first_line(path, what="password file")
    if not password:
        raise ConfigurationError(f"the password file {path} is empty", hint="write one line with the password into it")
    return password


def private_key_in(path: Path | None) -> bytes:
    """The private key in a file; without one, that on the standard input, or typed unseen on a terminal.

    Raises `InputError` for what is no private key, `ConfigurationError` for a file that can't be read.
    """
    if path is None:
        text, where = _asked("private key: "), "what was given"
    else:
        text, where = _first_line(path, what="private key"), f"the first line of {path}"
    digits = text.strip().removeprefix("0x")
    try:
        key = bytes.fromhex(digits)
    except ValueError:  # whose own text shows where in the key it went wrong
        key = b""
    if len(digits) != KEY_DIGITS or len(key) != KEY_DIGITS // 2:
        raise InputError(
            f"{where} is not a private key", hint="a private key is 64 hexadecimal digits, 0x before them or not"
        )
    return key


def password_of(keyfile: Path, path: Path | None) -> tuple[str, str]:
    """The password that opens a keyfile, and where it is from: a file, the standard input or a terminal."""
    if path is not None:
        return _first_line(path, what="password file"), str(path)
    return _asked(f"password of {keyfile}: "), "the answer"


def _asked(question: str) -> str:
    """A line of the standard input; from a terminal it is asked for, and not shown."""
    import getpass

    try:
        line = getpass.getpass(question) if sys.stdin.isatty() else sys.stdin.readline()
    except (EOFError, UnicodeDecodeError):
        line = ""
    line = line.rstrip("\r\n")
    if not line:
        raise InputError(
            f"nothing was given for the {question.removesuffix(': ')}", hint="give one line on the standard input"
        )
    return line


def _first_line(path: Path, *, what: str) -> str:
    """The first line of a file. Raises `ConfigurationError`, which shows nothing of it."""
    try:
        return path.read_text(encoding="utf-8").split("\n", 1)[0].rstrip("\r")
    except OSError as error:
        raise ConfigurationError(f"can't use the {what} {path}: {error.strerror}") from None
    except UnicodeDecodeError:  # whose own text shows a part of the secret
        raise ConfigurationError(f"can't use the {what} {path}: it is not UTF-8 text") from None
