"""What is looked at before anything is sent: whether a lighthouse can be as it is asked for, and whether it is one."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from mesh.cli.amounts import AMOUNT, XRT
from mesh.errors import ChainError, InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.chain import Chain
    from mesh.settings import Settings

LABEL: Final = re.compile(r"[a-z0-9-]{1,32}", re.ASCII)
LARGEST_STAKE: Final = 2**128 - 1


def check_lighthouse(name: str, *, minimal_stake: int) -> None:
    """Raise `InputError` for a name or a minimal stake (wn) that the factory would refuse."""
    if not LABEL.fullmatch(name):
        raise InputError(
            f"{name[:40]!r} can't be the name of a lighthouse",
            hint="1 to 32 letters a to z, digits and -, such as `airalab`",
        )
    if not 1 <= minimal_stake <= LARGEST_STAKE:
        raise InputError(f"a minimal stake of {XRT.show(minimal_stake)} can't be", hint="it is 1 wn at least")


def lighthouse_and_value(words: Sequence[str], settings: Settings) -> tuple[str, int | None]:
    """What `[LIGHTHOUSE] [VALUE]` means: a name, by default the settings', and an amount in wn, if there is one.

    One word alone is a VALUE if it looks like one. Raises `InputError`.
    """
    match words:
        case ():
            return settings.lighthouse_contract, None
        case (word,) if AMOUNT.fullmatch(word):
            return settings.lighthouse_contract, XRT.parse(word)
        case (name,):
            return name, None
        case (value, name) if AMOUNT.fullmatch(value) and not AMOUNT.fullmatch(name):
            raise InputError(f"{name!r} is not an amount", hint=f"the lighthouse comes first: {name} {value}")
        case (name, value):
            return name, XRT.parse(value)
    raise InputError("there are too many words", hint="give a LIGHTHOUSE and a VALUE")


async def find_lighthouse(chain: Chain, name: str) -> str:
    """The address of a lighthouse, by its label, ENS name or address.

    Raises `ChainError` for what is no lighthouse of the factory, `UnknownName`, `InvalidName`, `InvalidAddress`.
    """
    address = await chain.names.lighthouse(name)
    if not await chain.lighthouses.exists(address):
        raise ChainError(f"{address} is not a lighthouse of this factory", hint="`aira lighthouse list` shows those")
    return address
