"""Amounts of tokens as options of commands."""

from __future__ import annotations

from typing import Any

import click

from mesh.amounts import AMOUNT, XRT, InvalidAmount


class AmountText(click.ParamType[str]):
    """An amount. Its syntax is checked here; its value depends on the token. Raises `InvalidAmount`."""

    name = "amount"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the text."""
        text = str(value)
        if AMOUNT.fullmatch(text.strip()) is None:
            flag = f"{param.opts[0]}: " if isinstance(param, click.Option) else ""
            raise InvalidAmount(f"{flag}{text[:40]!r} is not an amount", hint=XRT.hint())
        return text
