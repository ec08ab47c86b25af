"""The contracts of the simulated market, and the accounts of those who take part."""

from __future__ import annotations

import gc
import random
from dataclasses import dataclass, replace
from typing import Final, Literal

import mesh.agent._runtime  # noqa: F401 - loaded once, before histories fork
from mesh.chain import XRT, Account, Chain, Timing
from mesh.chain.deploy import DeploymentPlan
from mesh.dev.development import ALLOWANCE, DevelopmentMarket, deploy_market
from schemas import cid_of_bytes, keccak256
from tests.simulation import loop, threads
from tests.simulation.chain import EvmChain, NodeFaults, SimulatedChain, SimulatedNode
from tests.simulation.model import ModelChain
from tests.simulation.scheduler import SECOND, Process, Scheduler

MODEL: Final = cid_of_bytes(b"aira-mesh simulation: a lamp\n")
ENDPOINT: Final = "tcp/127.0.0.1:7447"
JOBS: Final = 6
"""Jobs in a history, at most; with more, it is a long one."""
BLOCK_SECONDS: Final = 6.0
CROWDED_JOBS: Final = 100
"""From so many jobs on, people have several orders open at a time."""
AT_ONCE: Final = {3: (10, 30), 5: (2, 4)}
"""How many, each, at least and at most. In generation 5, an account's orders become contracts one after the other."""
FULL_BLOCK: Final = 100
"""Transactions in a block of a crowded market, at most."""
LONG_BLOCK_SECONDS: Final = 12.0
"""In long histories: as on Ethereum."""
TIMING: Final = Timing(poll_interval=3.0, receipt_interval=1.0, replace_after=30.0)
ON_EVM: Final = "evm"
ON_MODEL: Final = "model"
EVM_EVERY: Final = 20
"""One of so many seeds runs on the EVM."""
PEOPLE: Final = 2
MOST_PEOPLE: Final = 4
"""In long histories."""
ROBOTS: Final = 2
PAUSES: Final = (30.0, 300.0)
"""The most seconds between two jobs of a person, in long histories; the first one in the others."""
STEPS_NS: Final = (400_000_000, 4_000_000_000)
"""The same for nanoseconds between two messages of an objective."""
STAKE: Final = 100 * XRT
"""Of the second provider, in wn: as much as the first one has."""
PLAIN: Final = 0.5
"""How many markets are as small as possible."""
LIFETIMES: Final = (60, 90, 90)
"""Blocks for which an order is valid."""
SHORT_LIFETIMES: Final = (4, 8)
"""So few that it may expire while it is matched."""
JURORS: Final = 3
VALIDATED: Final = 0.4
"""How many markets of generation 5 have a validator."""
PLAN: Final = DeploymentPlan(timeout_blocks=100, refund_delay=100)


@dataclass(frozen=True)
class Deployed:
    """The market on the chain, and the account of each role."""

    chain: SimulatedChain
    market: DevelopmentMarket
    accounts: dict[str, Account]
    validator: str = ""
    """The address of the jury, if this market has one."""


@dataclass(frozen=True)
class MarketPlan:
    """What kind of market a history has."""

    generation: Literal[3, 5] = 3
    providers: int = 1
    nodes: int = 1
    """How many each process knows."""
    people: int = PEOPLE
    at_once: int = 1
    """The most orders that a person has open at a time."""
    pause: float = PAUSES[0]
    step_ns: int = STEPS_NS[0]
    block_seconds: float = BLOCK_SECONDS
    most_in_block: int = 1
    """The most transactions in a block."""
    jurors: int = 0
    """How many a validator has, which all demands name; a majority must agree."""

    @property
    def kinds(self) -> tuple[str, ...]:
        """What is not as in a plain market."""
        kinds = {
            "generation-5": self.generation == 5,
            "two-providers": self.providers > 1,
            "two-nodes": self.nodes > 1,
            "more-people": self.people > PEOPLE,
            "crowded": self.at_once > 1,
            "long-pauses": self.pause > PAUSES[0],
            "long-jobs": self.step_ns > STEPS_NS[0],
            "validated": self.jurors > 0,
        }
        return tuple(kind for kind, is_so in kinds.items() if is_so)


def market_plan(seed: int, jobs: int = JOBS) -> MarketPlan:
    """The market of a seed, in a history of so many jobs."""
    chance, plan = random.Random(f"market {seed}"), MarketPlan()
    if chance.random() >= PLAIN:
        plan = MarketPlan(5 if chance.random() < 0.5 else 3, chance.choice((1, 2)), chance.choice((1, 2)))
    if plan.generation == 5 and random.Random(f"validator {seed}").random() < VALIDATED:
        plan = replace(plan, jurors=JURORS)
    if jobs <= JOBS:
        return plan
    people, pause, step_ns = chance.randint(PEOPLE, MOST_PEOPLE), chance.choice(PAUSES), chance.choice(STEPS_NS)
    plan = replace(plan, people=people, pause=pause, step_ns=step_ns, block_seconds=LONG_BLOCK_SECONDS)
    if jobs < CROWDED_JOBS:
        return plan
    # Robots do one job at a time: with long ones they would have too much to do.
    at_once = random.Random(f"at once {seed}").randint(*AT_ONCE[plan.generation])
    return replace(plan, at_once=at_once, step_ns=STEPS_NS[0], most_in_block=FULL_BLOCK)


def found(chain: SimulatedChain, scheduler: Scheduler, *, jurors: int = 0) -> Deployed:
    """Deploy the contracts, and a jury if there are jurors, and give people and robots their tokens."""
    deployed: list[Deployed] = []
    keys = chain.evm.funded_keys
    names = [f"person-{number}" for number in range(PEOPLE)] + [f"robot-{number}" for number in range(ROBOTS)]
    names += ["provider-1", *(f"person-{number}" for number in range(PEOPLE, MOST_PEOPLE))]
    accounts = {name: Account(key) for name, key in zip(names, keys[3:], strict=False)}

    async def main() -> None:
        node = SimulatedNode(chain, NodeFaults())
        market = await deploy_market(node, keys, plan=PLAN)
        async with Chain(
            node, account=market.accounts["provider"], contracts=market.deployment.contracts, timing=TIMING
        ) as client:
            for account in accounts.values():
                await client.tokens.transfer(account.address, ALLOWANCE)
            validator = await _found_jury(client, accounts, jurors) if jurors else ""
        accounts["provider"] = market.accounts["provider"]
        deployed.append(Deployed(chain, market, accounts, validator))

    errors: list[BaseException | None] = []
    loop.start(scheduler, Process(scheduler, "deployment"), main, errors.append)
    scheduler.run(lambda: bool(errors), until_ns=scheduler.now_ns + 3600 * SECOND)
    if errors[0] is not None:
        raise errors[0]
    chain.begin()
    return deployed[0]


async def _found_jury(client: Chain, accounts: dict[str, Account], jurors: int) -> str:
    """Deploy a jury of new accounts, and add these to the others; its address."""
    judges = {f"juror-{number}": Account(keccak256(b"juror %d" % number)) for number in range(jurors)}
    accounts.update(judges)
    addresses = [account.address for account in judges.values()]
    return (await client.validators.deploy(addresses, jurors // 2 + 1)).address


class Deployments:
    """The markets on the model and on the EVM, each deployed once it is wanted; all of one kind if `only` names it."""

    def __init__(self, only: str | None = None) -> None:
        self._only = only
        self._found: dict[tuple[str, int], Deployed] = {}

    def kind(self, seed: int, jobs: int = JOBS) -> str:
        """What runs the contracts in the history of a seed: in crowded markets the model, for blocks of many."""
        if jobs >= CROWDED_JOBS:
            return ON_MODEL
        return self._only or (ON_EVM if random.Random(f"chain {seed}").randrange(EVM_EVERY) == 0 else ON_MODEL)

    def market(self, kind: str, *, jurors: int = 0) -> Deployed:
        """The market on a chain of that kind, with a validator if it has jurors."""
        if (kind, jurors) not in self._found:
            evm = EvmChain()
            chain = evm if kind == ON_EVM else ModelChain(evm.funded_keys)
            self._found[kind, jurors] = found(SimulatedChain(chain), threads.begin(0), jurors=jurors)
            # Histories run in forks of this process, without collections: what one runs would be chance.
            gc.collect()
            gc.freeze()
            gc.disable()
        return self._found[kind, jurors]
