"""Amounts of tokens as people write them, in commands and in programs.

One rule: a number alone counts whole tokens (`1.5` is one and a half XRT, as is `1.5 XRT`); a number that ends in `wn`
(XRT, 10^-9), `wei` (ETH, 10^-18) or `units` (any token) counts the smallest unit. Where any token pays, the amount may
name it: `3.50 USDC`, or by its address, `3.50 0x…`. In JSON amounts are text, in the smallest unit.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from mesh.errors import InputError

UNLIMITED: Final = 2**256 - 1
"""The largest number of a contract. As an allowance it is never used up."""
AMOUNT: Final = re.compile(
    r"(?P<whole>[0-9][0-9_]*|(?=\.[0-9]))(?:\.(?P<part>[0-9]+))?\s*(?P<ending>[A-Za-z]*)", re.ASCII
)

TOKEN_AMOUNT: Final = re.compile(
    r"(?P<number>(?:[0-9][0-9_]*|(?=\.[0-9]))(?:\.[0-9]+)?)"
    r"(?:\s*(?P<word>[A-Za-z]+)|\s+(?P<name>[A-Za-z][A-Za-z0-9._-]*|0[xX][0-9A-Fa-f]{40}))?",
    re.ASCII,
)
"""An amount that may name its token."""


class InvalidAmount(InputError, code="invalid-amount"):
    """A text is not an amount of the token."""


def split_amount(text: str) -> tuple[str, str]:
    """The number in an amount, and the name of its token; empty if it names none. Raises `InvalidAmount`."""
    found = TOKEN_AMOUNT.fullmatch(text.strip())
    if found is None:
        raise InvalidAmount(f"{text[:40]!r} is not an amount", hint="write it like 1.5, 1.5 XRT or 3.50 USDC")
    return found["number"], found["word"] or found["name"] or ""


@dataclass(frozen=True, slots=True)
class Unit:
    """What a token is called for people, its decimals, and the name of its smallest unit."""

    symbol: str
    decimals: int
    smallest: str = "units"

    def show(self, amount: int) -> str:
        """An amount of the smallest unit for people, with all its digits: `1,000.5 XRT`."""
        return f"{self.number(amount)} {self.symbol}"

    def number(self, amount: int) -> str:
        """As `show`, without the symbol."""
        if amount >= UNLIMITED:
            return "unlimited"
        whole, point, digits = self.decimal(amount).partition(".")
        return f"{int(whole):,}{point}{digits}"

    def decimal(self, amount: int) -> str:
        """An amount of the smallest unit for programs, with all its digits and nothing else: `1000.5`."""
        whole, part = divmod(amount, 10**self.decimals)
        return f"{whole}" + (f".{part:0{self.decimals}}".rstrip("0") if part else "")

    def parse(self, text: str) -> int:
        """Parse an amount into the smallest unit. Raises `InvalidAmount`."""
        found = AMOUNT.fullmatch(text.strip())
        if found is None:
            raise InvalidAmount(f"{text[:40]!r} is not an amount", hint=self.hint())
        whole, part, ending = found["whole"] or "0", (found["part"] or "").rstrip("0"), found["ending"].lower()
        if ending in (self.smallest, "units"):
            decimals = 0
        elif ending in ("", self.symbol.lower()):
            decimals = self.decimals
        else:
            raise InvalidAmount(f"{text[:40]!r} is not an amount of {self.symbol}", hint=self.hint())
        if len(part) > decimals:
            unit = self.symbol if decimals else self.smallest
            raise InvalidAmount(
                f"{text[:40]!r} has more than {decimals} decimals, the most that {unit} has", hint=self.hint()
            )
        amount = int(whole.replace("_", "") + part.ljust(decimals, "0"))
        if amount > UNLIMITED:
            raise InvalidAmount(f"{text[:40]!r} is more than a contract can store", hint=self.hint())
        return amount

    def amount(self, given: int | str) -> int:
        """What a program gives: a number of the smallest unit as it is, a text parsed. Raises `InvalidAmount`."""
        if isinstance(given, str):
            return self.parse(given)
        if not isinstance(given, int):
            raise InvalidAmount(f"{given!r} is not an amount: whole numbers count {self.smallest}", hint=self.hint())
        return given

    def hint(self) -> str:
        """Two ways to write one amount; a token without decimals has no half."""
        if not self.decimals:
            return f"two {self.symbol} are 2, or 2{self.smallest}"
        return f"one and a half {self.symbol} is 1.5, or {15 * 10**self.decimals // 10}{self.smallest}"


XRT: Final = Unit("XRT", 9, "wn")
ETH: Final = Unit("ETH", 18, "wei")
