"""Planted bugs: changes of production code. `make simulate-mutants` proves that the simulator finds them."""

from __future__ import annotations
import __future__

import importlib
import inspect
import textwrap
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from types import ModuleType

SEEDS: Final = 20
"""Within so many seeds each is found."""


@dataclass(frozen=True)
class Mutation:
    """A bug: in the function `target` (module:Class.method), the text `old` becomes `new`.

    `faults` are the kinds that bring it to light; the histories of its search have these only.
    """

    name: str
    target: str
    old: str
    new: str
    faults: str

    def apply(self) -> None:
        """Plant the bug in this process."""
        module, owner, name = self._find()
        planted: dict[str, Any] = {}
        flags = __future__.annotations.compiler_flag
        exec(compile(self.source(), f"<{self.name}>", "exec", flags=flags), module.__dict__, planted)
        setattr(owner, name, planted[name])

    def source(self) -> str:
        """The changed function. Raises `LookupError` if production code has changed and the mutation must follow."""
        _, owner, name = self._find()
        source = textwrap.dedent(inspect.getsource(getattr(owner, name)))
        if self.old not in source:
            raise LookupError(f"{self.name}: {self.target} has no {self.old!r}")
        return source.replace(self.old, self.new, 1)

    def _find(self) -> tuple[ModuleType, Any, str]:
        module_name, _, path = self.target.partition(":")
        module = importlib.import_module(module_name)
        owner: Any = module
        *parents, name = path.split(".")
        for parent in parents:
            owner = getattr(owner, parent, None)
        if not hasattr(owner, name):
            raise LookupError(f"{self.name}: there is no {self.target}")
        return module, owner, name


CRASHES: Final = "crash,crash_every"
REORGANISATIONS: Final = "reorganise_every"

MUTATIONS: Final = (
    Mutation(
        "the listener ignores reorganisations",
        "mesh.agent.listener:ChainListener._follow",
        "in block.reverted_events",
        "in ()",
        REORGANISATIONS + ",forget",
    ),
    Mutation(
        "a job that failed is a success",
        "mesh.work.executor:Executor._run_job",
        "success, note = False, str(error)",
        "success, note = True, str(error)",
        "late",
    ),
    Mutation(
        "the result is signed before the objective was played",
        "mesh.work.executor:Executor._run_job",
        "await self._playbacks.play_and_save(run, None if self._handlers is None else self._handlers.handle)",
        "pass",
        "late",
    ),
    Mutation(
        "the job of a reverted contract goes on",
        "mesh.work.ledger:Ledger.set_aside",
        "aside = 1",
        "aside = 0",
        REORGANISATIONS + ",forget",
    ),
    Mutation(
        "a result is not stored with the end of its job",
        "mesh.work.ledger:Ledger.complete",
        ", (POST, _posted(outgoing))",
        "",
        "late",
    ),
    Mutation(
        "an order is declared dead before its deadline",
        "mesh.agent.trade:Trader.new_head",
        "order.signed.deadline <= block",
        "order.signed.deadline <= block + 3",
        "delay,leave_out,partition_every",
    ),
    Mutation(
        "the listener's cursor runs ahead of what it has handled",
        "mesh.agent.listener:ChainListener._follow",
        "self.CURSOR, block.block_number - 1, history",
        "self.CURSOR, block.block_number, history",
        CRASHES,
    ),
)

CANDIDATES: Final = (
    Mutation(
        "the outbox sends nothing again after a restart",
        "mesh.work.outbox:Outbox.send_all",
        "self._attempts.clear()",
        "return\n    self._attempts.clear()",
        CRASHES,
    ),
    Mutation(
        "the outbox sends everything once",
        "mesh.work.outbox:Outbox.send_due",
        "await self._send(",
        "0 and (",
        "drop,partition_every",
    ),
    Mutation(
        "the provider trusts a receipt",
        "mesh.market.liability_events:LiabilityEvents.is_confirmed",
        "timing, missing =",
        "return True\n    timing, missing =",
        REORGANISATIONS + ",forget",
    ),
    Mutation(
        "the provider does not see a reorganisation",
        "mesh.market.liability_events:LiabilityEvents._revert",
        "created = [",
        "return\n    created = [",
        REORGANISATIONS,
    ),
    Mutation(
        "an interrupted job is played again from its beginning, into the same recording",
        "mesh.work.playbacks:Playbacks.begin",
        "await self.create(job, objective)",
        "await self.create(job, objective)\n    run.position = 0",
        CRASHES,
    ),
    Mutation(
        "orders of a reverted contract are forgotten",
        "mesh.agent.trade:Trader.liability_reverted",
        "await self._parts.outbox.unspend(address)",
        "None",
        REORGANISATIONS,
    ),
    Mutation(
        "a job that was set aside is never taken up again",
        "mesh.work.ledger:Ledger.add_job",
        " DO UPDATE SET aside = 0 WHERE aside",
        " DO NOTHING",
        REORGANISATIONS,
    ),
    Mutation(
        "a reorganisation is not looked for",
        "mesh.chain.following:_Follower._find_replaced",
        "known = [",
        "return None\n    known = [",
        REORGANISATIONS,
    ),
    Mutation(
        "a reverted payment is not asked for again",
        "mesh.agent.listener:ChainListener.finalization_reverted",
        "await self._owe_result(job)",
        "pass",
        REORGANISATIONS + ",forget",
    ),
    Mutation(
        "a withdrawal is not sent to the chain",
        "mesh.agent.trade:Trader.withdraw_on_chain",
        "tx = (await self._chain.liabilities.withdraw(order.signed)).tx",
        'tx = ""',
        "drop,leave_out,partition_every",
    ),
    Mutation(
        "the recording is stamped with the time of day",
        "mesh.recording.recorder:Recorder.record",
        "self._epoch + self._clock.monotonic_ns()",
        "self._clock.time_ns()",
        "clock_every",
    ),
    Mutation(
        "a provider forgets what it could not settle",
        "mesh.market.settlement:Settlement._finalize",
        "if not self._unconfirmed.end(result):\n                self._forget(result)",
        "pass",
        "unreachable,outage_every,price_every",
    ),
    Mutation(
        "a transaction whose answer is lost is sent with the next number",
        "mesh.chain.transactions:TransactionSender._sent_before",
        "if not pending.abandoned:",
        "if True:",
        "lost_after_sending,outage_every",
    ),
    Mutation(
        "the ledger's position runs ahead of the recording",
        "mesh.work.playbacks:Playbacks._save",
        "synced.position, recorded=synced.messages",
        "run.position + 1, recorded=0",
        CRASHES,
    ),
)
"""Bugs that `--mutant NAME` plants as well, but that were not found within so few seeds yet."""
