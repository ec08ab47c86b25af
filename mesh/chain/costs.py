"""What the transactions of a job take: measured gas, and bytes of data, for whoever plans with them.

`tests/contracts/test_gas.py` measures the gas again, on the same EVM as `bench/gas.py`.
"""

from __future__ import annotations

from typing import Final, NamedTuple


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
