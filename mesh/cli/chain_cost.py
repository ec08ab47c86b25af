"""`aira chain cost`: what a job costs on a chain, in its coin and in money.

It goes by measured gas, and by bytes of data. `tests/contracts/test_gas.py` measures the gas again, on the same EVM as
`bench/gas.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import click

from mesh.amounts import Unit
from mesh.cli.chain import GWEI
from mesh.cli.options import FiniteRange, with_chain_settings, with_json
from mesh.cli.output import print_json, print_line, print_table

if TYPE_CHECKING:
    from mesh.settings import Settings


class JobTransaction(NamedTuple):
    """A transaction of a job that pays in XRT.

    Its name among the measurements, who sends it and when; its gas in generations 3 and 5; the bytes of its data that
    are not zero, about.
    """

    name: str
    title: str
    sender: str
    gas: tuple[int, int]
    data: int

    def gas_in(self, generation: int) -> int:
        """Its gas in a generation."""
        return self.gas[generation == 5]


STEPS: Final = (
    JobTransaction("create_cost", "create the contract", "the provider", (206_600, 163_300), 450),
    JobTransaction("finalize_cost", "finalize it", "the provider", (112_400, 111_300), 130),
    JobTransaction("approve", "approve the factory", "the customer, once for many jobs", (45_900, 45_900), 45),
    JobTransaction("create_permit", "create it with a permit", "the provider, instead", (218_000, 174_600), 590),
    JobTransaction("refund", "refund it", "the customer, if nobody finalizes", (78_100, 78_500), 25),
    JobTransaction("withdraw_order", "withdraw an order on the chain", "its maker, if asked for", (46_200, 28_300), 37),
)
"""Each job has the first two."""

EACH_JOB: Final = 2
"""So many steps."""


@dataclass(frozen=True, slots=True)
class Priced:
    """A transaction with what it costs, in wei; `data` is the part of it for its data."""

    name: str
    title: str
    sender: str
    gas: int
    wei: int
    data: int

    def json(self, coin_price: float | None) -> dict[str, Any]:
        """The same for JSON."""
        facts = {"step": self.name, "gas": self.gas, "wei": str(self.wei), "dataWei": str(self.data)}
        return facts if coin_price is None else facts | {"usd": round(self.usd(coin_price), 6)}

    def usd(self, coin_price: float) -> float:
        """The same in money, by the price of a coin."""
        return self.wei / 10**18 * coin_price


@click.command("cost", short_help="show what a job costs, in the chain's coin and in money")
@click.option("--gas-price", help="gwei for a unit of gas, instead of asking the node; data is not counted then")
@click.option("--coin-price", type=FiniteRange(0, 1e12, min_open=True), help="USD for one of the chain's coin")
@with_json
@with_chain_settings("generation")
async def cost(settings: Settings, *, gas_price: str | None, coin_price: float | None, as_json: bool) -> None:
    """Show what the transactions of a job cost now on the chain of the settings, and who pays them.

    The gas is measured: that of a job that is paid in XRT, without a fee. Its price is the node's, and so is the fee
    for data on rollups of the OP type. With --gas-price no node is asked; --coin-price adds the price in money.
    """
    from mesh.role.composition import chain_of
    from mesh.settings.chains import profile_of

    profile, fees = settings.profile, [0] * len(STEPS)
    if gas_price is not None:
        price = GWEI.parse(gas_price)
    else:
        async with chain_of(settings, None).node as node:
            price = (await node.gas_market()).price
            fees = [await node.data_fee(b"\1" * step.data) for step in STEPS]
            profile = profile_of(node.chain_id) or profile
    steps = []
    for step, fee in zip(STEPS, fees, strict=True):
        gas = step.gas_in(settings.generation)
        steps.append(Priced(step.name, step.title, step.sender, gas, gas * price + fee, fee))
    gas, wei, data = (sum(getattr(one, name) for one in steps[:EACH_JOB]) for name in ("gas", "wei", "data"))
    job = Priced("job", "together: a job", "", gas, wei, data)
    if as_json:
        facts: dict[str, Any] = {"chain": profile.name, "coin": profile.coin, "gasPrice": str(price)}
        facts |= {"coinPrice": coin_price, "job": job.json(coin_price)}
        print_json(facts | {"steps": [one.json(coin_price) for one in steps]})
        return
    print_line(f"{profile.title}, gas at {GWEI.show(price)}")
    coin = Unit(profile.coin, 18, "wei")
    head = ("STEP", "WHO PAYS", "GAS", profile.coin, *(() if coin_price is None else ("USD",)))
    rows = []
    for one in (*steps[:EACH_JOB], job, *steps[EACH_JOB:]):
        money = () if coin_price is None else (f"{one.usd(coin_price):.4f}",)
        rows.append((one.title, one.sender, f"{one.gas:,}", coin.number(one.wei), *money))
    print_table(head, rows, numbers=head[2:])
    if profile.l1 == "op":
        is_counted = "counted" if gas_price is None else "not counted: leave out --gas-price to ask the node"
        print_line(f"the fee for data, beside the gas, is {is_counted}")
