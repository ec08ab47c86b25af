"""The table: which role fails at which point by which fault."""

from __future__ import annotations

from itertools import product
from typing import Final, NamedTuple

from tests.crashes.points import Point

BOOK, SETTLEMENT = "mesh.market.book:OrderBook", "mesh.market._settlement:Settlement"
RESULTS = "mesh.market._settlement:Results"
QUEUE, SENDER = "mesh.market.transactions:TransactionQueue", "mesh.chain.transactions:TransactionSender"
STORE, CONFIRMATION = "mesh.chain._pending:TransactionStore", "mesh.chain.transactions:Confirmation"
TRADER, OUTBOX = "mesh.agent.trade:Trader", "mesh.agent.ledger:Outbox"
LEDGER, LISTENER = "mesh.agent.ledger:Ledger", "mesh.agent._runtime:AgentRuntime"
RUN, CONTENT = "mesh.agent.jobs:JobRun", "mesh.content.store:Store"
EXECUTOR = "mesh.agent.jobs:Executor"
CASES, JUDGE = "mesh.validator.runtime:Cases", "mesh.validator.runtime:CaseJudge"
VERDICTS = "mesh.validator.ledger:VerdictLedger"

POINTS: Final = {
    "provider": (
        Point("before", f"{BOOK}.add"),
        Point("after", f"{BOOK}.add", 2),
        Point("before", f"{SETTLEMENT}._create"),
        Point("before", f"{QUEUE}.send"),
        Point("before", f"{SENDER}._send_numbered"),
        Point("after", f"{STORE}.add"),
        Point("after", f"{SENDER}._send_numbered"),
        Point("before", f"{CONFIRMATION}.wait"),
        Point("after", f"{CONFIRMATION}.wait"),
        Point("after", f"{SETTLEMENT}._create"),
        Point("before", f"{RESULTS}.settle"),
        Point("before", f"{RESULTS}._finalize"),
        Point("after", f"{SENDER}._send_numbered", 2),
        Point("after", f"{CONFIRMATION}.wait", 2),
        Point("after", f"{RESULTS}._finalize"),
    ),
    "robot": (
        Point("before", f"{TRADER}.post"),
        Point("before", f"{OUTBOX}.post"),
        Point("after", f"{LEDGER}.post"),
        Point("before", f"{LISTENER}.new_liability"),
        Point("after", f"{LEDGER}.add_job"),
        Point("before", f"{EXECUTOR}._fetch"),
        Point("after", f"{LEDGER}.set_phase"),
        Point("before", f"{EXECUTOR}._begin"),
        Point("before", f"{RUN}._handle_one", 3),
        Point("after", f"{RUN}._save"),
        Point("before", f"{EXECUTOR}._stop"),
        Point("after", f"{RUN}.close"),
        Point("after", f"{CONTENT}.put_file"),
        Point("before", f"{LEDGER}.complete"),
        Point("after", f"{LEDGER}.complete"),
        Point("before", f"{LISTENER}.finalized"),
        Point("after", f"{LISTENER}.finalized"),
    ),
    "validator": (
        Point("before", f"{CASES}.open"),
        Point("after", f"{VERDICTS}.open"),
        Point("before", f"{VERDICTS}.take"),
        Point("after", f"{VERDICTS}.take"),
        Point("before", f"{JUDGE}._fetch"),
        Point("before", f"{JUDGE}._judge"),
        Point("after", f"{JUDGE}._judge"),
        Point("before", f"{VERDICTS}.sign"),
        Point("after", f"{VERDICTS}.sign"),
        Point("before", f"{CASES}._settle"),
        Point("after", f"{SENDER}._send_numbered"),
        Point("after", f"{CONFIRMATION}.wait"),
        Point("after", f"{CASES}._settle"),
        Point("before", f"{CASES}.end"),
        Point("after", f"{CASES}.end"),
    ),
    "person": (
        Point("before", f"{TRADER}.post"),
        Point("after", f"{TRADER}.post"),
        Point("before", f"{OUTBOX}.post"),
        Point("before", f"{LEDGER}.post"),
        Point("after", f"{LEDGER}.post"),
        Point("after", f"{OUTBOX}.post"),
        Point("before", f"{LISTENER}.new_liability"),
        Point("before", f"{TRADER}.matched"),
        Point("after", f"{OUTBOX}.spend"),
        Point("after", f"{TRADER}.matched"),
        Point("after", f"{LEDGER}.set_cursor", 5),
        Point("before", f"{LISTENER}.finalized"),
        Point("after", f"{LISTENER}.finalized"),
    ),
}
"""The points of each role, in the order of a job."""

SETTLING: Final = (f"{CASES}._settle", f"{SENDER}._send_numbered", f"{CONFIRMATION}.wait")
"""What a validator does in generation 3 only."""

JURY_POINTS: Final = {
    "provider": (
        Point("before", f"{RESULTS}._judge"),
        Point("after", f"{RESULTS}._judge"),
        Point("before", f"{RESULTS}._hold"),
        Point("after", f"{RESULTS}._hold"),
        *POINTS["provider"][-4:],  # from the finalization on
    ),
    "validator": (
        *(point for point in POINTS["validator"] if not point.method.endswith(SETTLING)),
        Point("before", f"{CASES}._send"),
        Point("after", f"{CASES}._send"),
    ),
}
"""The points of a job that a jury judges, and a provider finalizes by what it has signed."""

SHARED: Final = (
    *(("provider", point) for point in POINTS["provider"][::3]),
    *(("robot", point) for point in POINTS["robot"][1::3]),
    *(("person", point) for point in POINTS["person"][2::5]),
)
"""The points at which the router and the node fail, with the process that reaches them."""

FAULTS: Final = {
    "provider": ("kill", "stop", "disk", "clock"),
    "robot": ("kill", "stop", "disk", "clock"),
    "validator": ("kill", "stop", "disk", "clock"),
    "person": ("kill", "stop", "disk", "clock"),
    "router": ("kill", "stop"),
    "node": ("stop", "reorganise"),
}


class Cell(NamedTuple):
    """`victim` fails by `fault` when the process `at` reaches `point`. In generation 5 a jury judges the job."""

    victim: str
    fault: str
    at: str
    point: Point
    generation: int = 3

    @property
    def name(self) -> str:
        jury = "jury-" if self.generation == 5 else ""
        return f"{jury}{self.victim}-{self.fault}-{'' if self.at == self.victim else f'{self.at}-'}{self.point.name}"


CELLS: Final = (
    *(
        Cell(victim, fault, at, point)
        for victim, faults in FAULTS.items()
        for (at, point), fault in product(
            [(victim, point) for point in POINTS[victim]] if victim in POINTS else SHARED, faults
        )
    ),
    *(
        Cell(victim, fault, victim, point, generation=5)
        for victim, points in JURY_POINTS.items()
        for point, fault in product(points, FAULTS[victim])
    ),
)
