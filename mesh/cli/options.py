"""Options of commands: those of the settings, addresses, amounts, CIDs and ports."""

from __future__ import annotations

import math
from functools import partial, wraps
from inspect import iscoroutinefunction
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.amounts import AMOUNT, TOKEN_AMOUNT, XRT, InvalidAmount
from mesh.cli.output import printable
from mesh.errors import InputError
from mesh.role.running import run_to_end
from mesh.settings import DEFAULTS, MEANING, AccountSettings, load, options_of
from schemas import InvalidKey
from schemas.address import parse_address_or_name
from schemas.decoding import InvalidData, decode_json
from schemas.keys import topic_chunks

if TYPE_CHECKING:
    from collections.abc import Callable


class AmountText(click.ParamType[str]):
    """An amount. Its syntax is checked here; its value depends on the token. Raises `InvalidAmount`."""

    name = "amount"
    pattern = AMOUNT

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the text."""
        text = str(value)
        if self.pattern.fullmatch(text.strip()) is None:
            flag = f"{param.opts[0]}: " if isinstance(param, click.Option) else ""
            raise InvalidAmount(f"{flag}{text[:40]!r} is not an amount", hint=XRT.hint())
        return text


class TokenAmountText(AmountText):
    """An amount that may name its token: `3.50 USDC`."""

    pattern = TOKEN_AMOUNT


class FiniteRange(click.FloatRange):
    """A range of numbers. NaN, which click takes for a member of every range, and infinity are in none."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{number} is not a finite number.", param, ctx)
        return number


PATH: Final = click.Path(path_type=Path)
FILE: Final = click.Path(dir_okay=False, path_type=Path)
FOLDER: Final = click.Path(file_okay=False, path_type=Path)
PORT: Final = click.IntRange(0, 65_535)
BLOCK_TIME: Final = FiniteRange(0.01, 86_400)
"""Seconds."""
SECONDS: Final = FiniteRange(0, 366 * 86_400, min_open=True)
"""A time of at most a year."""

CHAIN_SETTINGS: Final = (
    "chain",
    "web3_http_provider",
    "ens_contract",
    "factory_contract",
    "xrt_contract",
    "generation",
    "contracts",
)
"""The settings that name a chain, and the contracts on it."""
TRANSACTION_SETTINGS: Final = ("data_dir", "max_fee_gwei", "confirmations", "poll_interval")
"""The settings for sending transactions."""


class MessageText(click.ParamType[tuple[str, Any]]):
    """A message of an objective: a topic and, in JSON, its value; None if there is no value. Raises `InputError`."""

    name = "topic [json]"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, Any]:
        """Return the topic and the value."""
        topic, _, text = str(value).strip().partition(" ")
        try:
            return str(topic_chunks(topic)), decode_json(text) if text.strip() else None
        except (InvalidKey, InvalidData) as error:
            raise InputError(
                f"{printable(str(value)[:60])!r} is not a topic and its value in JSON: {error}",
                hint="""a message is like '/blink {"times": 2}', or '/blink' without a value""",
                code="invalid-line",
            ) from None


def with_objective(function: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options that say what is done: `objective`, or `messages`; see `objective_given`."""
    options = (
        click.option("--objective", help="objective to play: a file or a CID"),
        click.option(
            "--message",
            "messages",
            type=MessageText(),
            multiple=True,
            help="""instead of --objective: a message to play, as '/blink {"times": 2}' (may be repeated)""",
        ),
    )
    for option in reversed(options):
        function = option(function)
    return function


class AddressText(click.ParamType[str]):
    """An address, or an ENS name that the chain resolves later. Raises `InvalidAddress` for any other text."""

    name = "address"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the text."""
        if value:
            parse_address_or_name(value)
        return str(value)


class TokenText(AddressText):
    """A token's address or ENS name, or the symbol of a token that is known on the chain, which is looked up later."""

    name = "token"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the text."""
        text = str(value)
        return (
            text
            if text.isascii() and text.replace(".", "").isalnum() and text[0].isalpha()
            else super().convert(value, param, ctx)
        )


ADDRESS: Final = AddressText()
TOKEN: Final = TokenText()


def with_settings(*named: str | type) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Give a command `--config` and a flag for each named setting, or each of a group; it is called with `settings`.

    Flags override `AIRA_*` variables, which override the settings file. A command that is a coroutine function is run
    to its end, as `run_to_end` does.
    """
    names = tuple(
        dict.fromkeys(name for each in named for name in ((each,) if isinstance(each, str) else options_of(each)))
    )

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def command(config: Path | None, **options: Any) -> Any:
            # An empty text is a value; an empty list is not, because click also passes one when the flag is absent.
            flags = {name: None if (value := options.pop(name)) == () else value for name in names}
            work = partial(function, settings=load(path=config, flags=flags), **options)
            return run_to_end(work) if iscoroutinefunction(function) else work()

        decorated: Callable[..., Any] = command
        for name in reversed(names):
            decorated = _flag(name)(decorated)
        return click.option("--config", type=FILE, envvar="AIRA_CONFIG", help="settings file (TOML)")(decorated)

    return decorate


def with_chain_settings(*more: str | type) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Give a command that only reads a chain its settings, the keyfile (for the address in it), and `more`."""
    return with_settings(*more, "keyfile", *CHAIN_SETTINGS)


def with_signing_settings(*more: str | type) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Give a command that sends transactions the settings of chain and account, and `more`."""
    return with_settings(*more, AccountSettings, *CHAIN_SETTINGS, *TRANSACTION_SETTINGS)


def with_json(function: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the flag `--json`; it is called with `as_json`."""
    return click.option("--json", "as_json", is_flag=True, help="print JSON only to stdout")(function)


def with_timeout(seconds: float | None = 3.0, *, meaning: str = "seconds to wait") -> Callable[..., Any]:
    """Give a command `--timeout`."""
    return click.option("--timeout", type=SECONDS, default=seconds, show_default=seconds is not None, help=meaning)


def with_first_block(meaning: str) -> Callable[..., Any]:
    """Give a command `--from-block`."""
    return click.option("--from-block", type=click.IntRange(min=0), default=0, show_default=True, help=meaning)


def with_lighthouse_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command that creates a lighthouse `--minimal-stake` and `--timeout-blocks`."""
    stake = click.option(
        "--minimal-stake", default="1", show_default=True, help="least stake of a provider, in XRT (1.5) or wn (5wn)"
    )
    timeout = click.option(
        "--timeout-blocks",
        type=click.IntRange(1, 2**32 - 1),
        default=25,
        show_default=True,
        help="blocks without a transaction after which another provider may take the turn",
    )
    return stake(timeout(command))


def _flag(name: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    default = getattr(DEFAULTS, name)
    shown = ", ".join(default) if isinstance(default, tuple) else str(default)
    metavar = name.split("_")[-1].upper()
    if isinstance(default, bool):
        shown, metavar = shown.lower(), "true|false"
    text = MEANING[name] + (f" [{shown}]" if shown else "")
    return click.option(
        f"--{name.replace('_', '-')}", name, multiple=isinstance(default, tuple), metavar=metavar, help=text
    )
