"""`aira validator deploy` and `collect`: validator contracts of generation 5, and their fees."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import click

from mesh.amounts import ETH, XRT
from mesh.cli.amounts import AmountText
from mesh.cli.chain_client import notice_when_slow, open_signing_chain
from mesh.cli.errors import InvalidOptions
from mesh.cli.options import ADDRESS, with_json, with_signing_settings
from mesh.cli.output import plural, print_facts, print_json, print_line

if TYPE_CHECKING:
    from mesh.chain import DeployedJury
    from mesh.settings import Settings

NEXT: Final = """
each juror runs:    aira validator --validator-contract {address}
promisees demand:   aira demand --validator {address} …
you collect fees:   aira validator collect {address}"""


@click.command("deploy", short_help="create a validator contract and name its jurors")
@click.option(
    "--juror",
    "jurors",
    multiple=True,
    type=ADDRESS,
    help="address or ENS name of an account that judges; repeat it for up to 7 [the settings' account]",
)
@click.option("--quorum", type=int, help="how many jurors must sign the same result [more than half of them]")
@with_json
@with_signing_settings()
async def deploy(settings: Settings, *, jurors: tuple[str, ...], quorum: int | None, as_json: bool) -> None:
    """Create a contract that demands of generation 5 can name as validator.

    A result counts when a quorum of its jurors has signed it. Jurors and quorum can't be changed later; with a new
    jury, deploy another contract. The settings' account pays the gas, and alone collects the fees.
    """
    async with open_signing_chain(settings) as chain:
        assert chain.account is not None
        keeper = chain.account.address
        named = jurors or (keeper,)
        with notice_when_slow():
            made = await chain.validators.deploy(named, len(named) // 2 + 1 if quorum is None else quorum)
    if as_json:
        facts = {"validator": made.address, "keeper": keeper, "jurors": made.jurors, "quorum": made.quorum}
        print_json(facts | {"tx": made.tx, "gas": made.gas_used, "wei": str(made.wei)})
    else:
        _print_deployed(made)


def _print_deployed(made: DeployedJury) -> None:
    first, *others = made.jurors
    facts = {"validator": made.address, "quorum": f"{made.quorum} of {plural(len(made.jurors), 'juror')}"}
    print_facts(facts | {"jurors": first})
    for juror in others:
        print_line(f"{'':11}{juror}")
    print_facts({"transaction": made.tx, "gas": f"{made.gas_used:,}, {ETH.show(made.wei)}"})
    print_line(NEXT.format(address=made.address))


@click.command("collect", short_help="pay out the fees of a validator contract")
@click.argument("contract", required=False, type=ADDRESS)
@click.option("--value", type=AmountText(), help="how much, in XRT (1.5) or wn (5wn) [all]")
@with_json
@with_signing_settings("validator_contract")
async def collect(settings: Settings, *, contract: str | None, value: str | None, as_json: bool) -> None:
    """Pay the fees that CONTRACT (by default that of the settings) has earned to the account that deployed it."""
    address = contract or settings.validator_contract
    if not address:
        raise InvalidOptions("no validator contract is given", hint="give its address, or set validator_contract")
    wanted = None if value is None else XRT.parse(value)
    async with open_signing_chain(settings) as chain:
        with notice_when_slow():
            paid = await chain.validators.collect(address, wanted)
        jury = await chain.validators.jury(address)
    left = 0 if jury is None else jury.fees
    if as_json:
        facts = {"validator": jury.address if jury else address, "collected": str(paid.value), "left": str(left)}
        print_json(facts | {"tx": paid.tx, "gas": paid.gas_used, "wei": str(paid.wei)})
        return
    print_facts(
        {
            "collected": XRT.show(paid.value),
            "left": XRT.show(left),
            "transaction": paid.tx,
            "gas": f"{paid.gas_used:,}, {ETH.show(paid.wei)}",
        }
    )
