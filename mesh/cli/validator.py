"""`aira validator`: judges results before they are paid; it also deploys contracts, collects fees, checks files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import click

from mesh.cli.lazy import LazyGroup
from mesh.cli.options import with_settings
from mesh.settings import (
    AccountSettings,
    ChainSettings,
    ContentSettings,
    NetworkSettings,
    TelemetrySettings,
    ValidatorSettings,
    options_of,
)

if TYPE_CHECKING:
    from mesh.settings import Settings

COMMANDS: Final = {
    "check": ("mesh.cli.validator_check:command", "judge a recording by hand"),
    "collect": ("mesh.cli.validator_jury:collect", "pay out the fees of a validator contract"),
    "deploy": ("mesh.cli.validator_jury:deploy", "create a validator contract and name its jurors"),
}


@click.group("validator", cls=LazyGroup, lazy=COMMANDS, invoke_without_command=True)
@with_settings(
    *options_of(NetworkSettings),
    "lighthouse_contract",
    *options_of(ValidatorSettings),
    *options_of(AccountSettings),
    *options_of(ChainSettings),
    *options_of(ContentSettings),
    "blocked_signers",
    *options_of(TelemetrySettings),
)
def command(settings: Settings) -> None:
    """Judge the results of liabilities that name this validator, and sign what counts. Ctrl-C stops it.

    In generation 5 the validator is a contract (validator_contract) of which this account is a juror. In generation 3
    it is this account itself, which also needs ETH for gas.
    """
    if click.get_current_context().invoked_subcommand is None:
        from mesh.validator.validator import Validator

        Validator(settings=settings).run()
