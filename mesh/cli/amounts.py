"""Amounts of money as people write them.

One rule for all commands: a number alone counts whole tokens (`1.5` is one and a half XRT), a number with the ending
`wn` (XRT, 10^-9), `wei` (ETH, 10^-18) or `units` (any token) counts the smallest unit. JSON has amounts in the smallest
unit, as text.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from mesh.errors import InputError

UNLIMITED: Final = 2**256 - 1
"""What is not used up when it is approved, and the most that a contract can count."""
AMOUNT: Final = re.compile(
    r"(?P<whole>[0-9][0-9_]*|(?=\.[0-9]))(?:\.(?P<part>[0-9]+))?\s*(?P<ending>[A-Za-z]*)", re.ASCII
)


@dataclass(frozen=True, slots=True)
class Unit:
    """What an amount is an amount of: a token's symbol, its decimals, and what its smallest unit is called."""

    symbol: str
    decimals: int
    smallest: str = "units"

    def show(self, amount: int) -> str:
        """An amount of the smallest unit, e.g. `1,000.5 XRT`; all its digits."""
        return f"{self.number(amount)} {self.symbol}"

    def number(self, amount: int) -> str:
        """The same without the symbol."""
        if amount >= UNLIMITED:
            return "unlimited"
        whole, part = divmod(amount, 10**self.decimals)
        digits = f".{part:0{self.decimals}}".rstrip("0") if part else ""
        return f"{whole:,}{digits}"

    def parse(self, text: str) -> int:
        """The amount in the smallest unit that a text means. Raises `InputError` for what is none."""
        found = AMOUNT.fullmatch(text.strip())
        if found is None:
            raise InputError(f"{text[:40]!r} is not an amount", hint=self._hint())
        whole, part, ending = found["whole"] or "0", (found["part"] or "").rstrip("0"), found["ending"].lower()
        if ending in (self.smallest, "units"):
            decimals = 0
        elif ending in ("", self.symbol.lower()):
            decimals = self.decimals
        else:
            raise InputError(f"{text[:40]!r} is not an amount of {self.symbol}", hint=self._hint())
        if len(part) > decimals:
            unit = self.symbol if decimals else self.smallest
            raise InputError(f"{text[:40]!r} has more decimals than {unit} has ({decimals})", hint=self._hint())
        amount = int(whole.replace("_", "") + part.ljust(decimals, "0"))
        if amount > UNLIMITED:
            raise InputError(f"{text[:40]!r} is more than a contract can count", hint=self._hint())
        return amount

    def _hint(self) -> str:
        return f"write 1.5 for one and a half {self.symbol}, or the smallest unit: 1500000{self.smallest}"


XRT: Final = Unit("XRT", 9, "wn")
ETH: Final = Unit("ETH", 18, "wei")
