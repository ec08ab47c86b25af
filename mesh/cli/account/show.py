"""`aira account show`: an address, and what it holds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mesh.cli.account.words import FILE, print_account
from mesh.cli.amounts import ETH, XRT
from mesh.cli.opening import claimed_address, for_reading, needed_address, reading
from mesh.cli.printing import print_facts, print_json, with_json
from mesh.errors import AiraError
from mesh.running import fail, run_to_end

if TYPE_CHECKING:
    from mesh.settings import Settings


@click.command("show")
@click.argument("file", metavar="[KEYFILE]", required=False, type=FILE)
@click.option("--balance", is_flag=True, help="ask the chain for its ETH, XRT and the nonce of its next order")
@with_json
@for_reading()
def command(settings: Settings, file: Path | None, balance: bool, as_json: bool) -> None:
    """Print the address of the account in KEYFILE (by default the settings'); needs no password."""
    try:
        address = needed_address(settings) if file is None else claimed_address(file)
    except AiraError as error:
        fail(error)
    if balance:
        run_to_end(lambda: _show_balance(settings, address, as_json))
    else:
        print_account(address, file or Path(settings.keyfile), as_json)


async def _show_balance(settings: Settings, address: str, as_json: bool) -> None:
    from mesh.chain import NotOffered

    async with reading(settings) as chain:
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
