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


@dataclass(frozen=True)
class Mutation:
    """A bug: in the function `target` (module:Class.method), the text `old` becomes `new`.

    `faults` are the kinds that bring it to light; the histories of its search have these only, and `jobs`. It is found
    within `seeds` of them.
    """

    name: str
    target: str
    old: str
    new: str
    faults: str
    seeds: int = 20
    jobs: int = 4

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
        found: Any = getattr(owner, name)
        function: Any = found.fget if isinstance(found, property) else found
        source = textwrap.dedent(inspect.getsource(function))
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


def planted(name: str) -> Mutation:
    """The bug with this name. Raises `LookupError`."""
    found = next((one for one in (*MUTATIONS, *CANDIDATES) if one.name == name), None)
    if found is None:
        raise LookupError(f"there is no planted bug {name!r}")
    return found


CRASHES: Final = "crash,crash_every"
REORGANISATIONS: Final = "reorganise_every,reorganise_after,forget"

MUTATIONS: Final = (
    Mutation(
        "the listener ignores reorganisations",
        "mesh.role.following:_take_block",
        "in block.reverted_events",
        "in ()",
        REORGANISATIONS,
    ),
    Mutation(
        "a job that failed is a success",
        "mesh.agent.jobs:Executor._run_job",
        "success, note = False, note_of(error)",
        "success, note = True, note_of(error)",
        "late",
    ),
    Mutation(
        "the result is signed before the objective was played",
        "mesh.agent.jobs:Executor._run_job",
        "await run.play_and_save(None if self._handlers is None else self._handlers.handle, self._ledger)",
        "pass",
        "late",
    ),
    Mutation(
        "the job of a reverted contract goes on",
        "mesh.agent.ledger:Ledger.set_aside",
        "aside = 1",
        "aside = 0",
        REORGANISATIONS,
    ),
    Mutation(
        "a result is not stored with the end of its job",
        "mesh.agent.ledger:Ledger.complete",
        ", (POST, _posted(outgoing))",
        "",
        "late",
    ),
    Mutation(
        "an order is declared dead before its deadline",
        "mesh.agent.trade:Trader.new_head",
        "order.deadline <= block",
        "order.deadline <= block + 3",
        "delay,leave_out,partition_every,short_lived",
    ),
    Mutation(
        "open orders of an earlier run are sent again without being taken up",
        "mesh.agent.trade:Trader.load",
        "for stored in await self._parts.ledger.orders():",
        "for stored in ():",
        CRASHES,
    ),
    Mutation(
        "a spoiled answer of a node escapes",
        "mesh.chain.rpc:RpcClient.answered",
        "except CONNECTION_ERRORS as error:",
        "except OSError as error:",
        "spoilt",
    ),
    Mutation(
        "the ledger is not synced",
        "mesh.base.database:RoleLedger._run_together",
        "if sync:",
        "if False:",
        CRASHES,
        seeds=40,
    ),
    Mutation(
        "nobody may take the cost back",
        "mesh.chain.liabilities:RefundState.is_refundable",
        "return not self.is_finalized",
        "return self.is_finalized",
        "leave,crash_every",
        seeds=80,
        jobs=6,
    ),
    Mutation(
        "people are told the opposite of how a contract ended",
        "mesh.agent._runtime:AgentRuntime.finalized",
        "Outcome(success=success, result=result)",
        "Outcome(success=not success, result=result)",
        "late",
    ),
    Mutation(
        "a job that was paid stays open in the ledger",
        "mesh.agent._runtime:AgentRuntime.finalized",
        "await self.parts.ledger.set_phase(address, advance(address, job.phase, Phase.FINALIZED))",
        "pass",
        "late",
    ),
    Mutation(
        "the signed result says the opposite of how the job ended",
        "mesh.agent.jobs:Executor.owe_result",
        "Result(liability=address, result=result, success=success)",
        "Result(liability=address, result=result, success=not success)",
        "late",
    ),
    Mutation(
        "the recording of a job is not kept",
        "mesh.agent.jobs:Executor.finish",
        "await asyncio.to_thread(self._store.put_file, summary.path, pin=address)",
        '__import__("schemas").cid_of_file(summary.path)',
        "late",
    ),
    Mutation(
        "the outbox sends everything once",
        "mesh.agent.ledger:Outbox.send_due",
        "one.backoff.next_delay() or 0.0",
        "1e9",
        "drop",
    ),
    Mutation(
        "a rejection is taken for the end of the order",
        "mesh.agent.trade:Trader._rejected",
        "elif order.reject(rejection):",
        "elif fail_future(order.created, OrderExpired(identity, 0)) or order.reject(rejection):",
        "late,revoke",
    ),
    Mutation(
        "a withdrawal is not sent to the chain",
        "mesh.agent.trade:Trader.withdraw_on_chain",
        "tx = (await self._chain.liabilities.withdraw(order.signed)).tx",
        'tx = ""',
        "drop,delay,leave_out,partition_every,withdraw",
        seeds=40,
    ),
    Mutation(
        "a reorganisation is not looked for",
        "mesh.chain.following:_Follower._find_replaced",
        "known = [",
        "return None\n    known = [",
        REORGANISATIONS,
    ),
    Mutation(
        "open orders lose their allowance in a reorganisation",
        "mesh.agent.trade:Trader._cover_and_send",
        "await chain.retrying(partial(self._ensure, order), outages=self._parts.outages)",
        "pass",
        "reorganise_after,forget",
        seeds=400,
    ),
    Mutation(
        "each transaction is sent twice",
        "mesh.chain.transactions:TransactionSender.send",
        "entry = before or await self._send_new(fields)",
        "entry = before or (await self._send_new(fields), await self._send_new(fields))[0]",
        "late",
    ),
    Mutation(
        "an order that waits for its allowance keeps its agent busy",
        "mesh.agent.ledger:Outbox._wait",
        "asyncio.timeout(remaining)",
        "asyncio.timeout(0 if self._held else remaining)",
        f"{REORGANISATIONS},revoke,late,unreachable",
        seeds=40,
    ),
    Mutation(
        "the provider ignores withdrawals",
        "mesh.market._orders:Orders.taken_back",
        "if identity in self._withdrawn",
        "if False",
        "repeat_every,replay,drop,duplicate,delay,withdraw",
        seeds=480,
    ),
    Mutation(
        "the ledger's position runs ahead of the recording",
        "mesh.agent.jobs:JobRun._save",
        "address, position, recorded=messages",
        "address, self.position + 1, recorded=0",
        CRASHES,
        seeds=120,
        jobs=6,
    ),
    Mutation(
        "the provider does not see a reorganisation",
        "mesh.market._settlement:LiabilityEvents.on_revert",
        "self._reverted.append(event)",
        "pass",
        REORGANISATIONS,
        seeds=120,
    ),
    Mutation(
        "messages are recorded with the time of day",
        "mesh.recording._recorder:Recorder.record",
        "self._epoch + self._clock.monotonic_ns()",
        "self._clock.time_ns()",
        "clock_every",
        seeds=150,
    ),
    Mutation(
        "the listener's cursor runs ahead of what it has handled",
        "mesh.role.following:_take_block",
        "block.block_number - 1, history",
        "block.block_number, history",
        CRASHES,
        seeds=80,
    ),
    Mutation(
        "orders of a reverted contract are forgotten",
        "mesh.agent.trade:Trader.liability_reverted",
        "await self._parts.outbox.unspend(address)",
        "None",
        REORGANISATIONS + ",crash_every",
        seeds=60,
    ),
    Mutation(
        "an order that its maker can't pay is forgotten",
        "mesh.market._settlement:Settlement._set_aside_unfunded",
        "self.set_aside(order, reason, detail)",
        "continue",
        "late,revoke",
        seeds=400,
    ),
    Mutation(
        "a job that was stopped is a success",
        "mesh.agent.jobs:Executor.finish",
        "success = self._is_paid_when_stopped and",
        "success = True or",
        "stop,owner_stop",
    ),
    Mutation(
        "a waiting job that was handed back is done all the same",
        "mesh.agent.jobs:Executor.stop",
        "if stopped is None:",
        "if stopped is None and (not code or job.phase is Phase.RUNNING):",
        "hand_back",
    ),
    Mutation(
        "a job is ordered again before its cost has come back",
        "mesh.agent._attempts:Attempts._end_of",
        "ended = await contract.end(self._report)",
        "failed = asyncio.Event()\n"
        "        hear = lambda said: failed.set() if said.code == 'failed' else None\n"
        "        ends = asyncio.ensure_future(contract.end(hear)), asyncio.ensure_future(failed.wait())\n"
        "        await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)\n"
        "        from mesh.agent.contracts import Outcome\n"
        "        early = Outcome(success=False, result='', robot=contract.robot, contract=contract.address)\n"
        "        ended = ends[0].result() if ends[0].done() else early",
        "retry,hand_back",
    ),
    Mutation(
        "a job is ordered again from the robot that has failed",
        "mesh.agent._attempts:Attempts._next",
        "{one.robot for one in earlier}",
        "()",
        "retry,hand_back",
    ),
    Mutation(
        "a job that its customer has stopped is ordered again",
        "mesh.agent._attempts:Attempts.run",
        "if not (ended.success or is_customers or number > self._total):",
        "self._called_off.clear()\n            if not (ended.success or number > self._total):",
        "retry,stop",
        seeds=60,
    ),
    Mutation(
        "a job that failed is not ordered again",
        "mesh.agent._attempts:Attempts.run",
        "if not (ended.success or is_customers or number > self._total):",
        "if False:",
        "retry,hand_back",
    ),
    Mutation(
        "a demand for one robot is shown to all",
        "mesh.agent.ledger:Outbox.send_due",
        "if not one.robot:",
        "if True:",
        "pair",
    ),
    Mutation(
        "a pair is sent to the providers once",
        "mesh.agent.hiring:Hiring.send",
        "task.add_done_callback(lambda _task: self._under_way.discard(order))",
        "pass",
        "pair,drop",
        seeds=60,
    ),
)

CANDIDATES: Final = (
    Mutation(
        "a count that a node states is believed, whatever it is",
        "mesh.chain.answers:_decode_value",
        "if kind is Count and number >> 63:",
        "if False:",
        "spoilt",
        seeds=400,
    ),
    Mutation(
        "of lost nonces only the first is filled at once",
        "mesh.chain.transactions:TransactionSender._use_nonces",
        'gap = await self.node.transaction_count(self.account.address, block="pending")',
        "return",
        REORGANISATIONS + ",crash_every,leave_out",
        jobs=100,
    ),
    Mutation(
        "a provider settles older versions of an order",
        "mesh.market._orders:OrderVersions.refusal",
        "if (key := self._keys.get(identity)) is None or (family := self._find(key)) is None:",
        "if True:",
        REORGANISATIONS + ",repeat_every",
        jobs=100,
    ),
    Mutation(
        "another version of an order is settled although a failed transaction may succeed",
        "mesh.market._orders:OrderVersions._is_open",
        "return undecided",
        "return False and undecided",
        REORGANISATIONS + ",revoke",
        jobs=100,
    ),
    Mutation(
        "the contract of an earlier version of an order is not recognized",
        "mesh.agent.orders:earlier_version",
        "for order in orders:",
        "for order in ():",
        REORGANISATIONS + ",repeat_every",
        jobs=100,
    ),
    Mutation(
        "a new agent does not remember the block at which it began",
        "mesh.role.following:first_position",
        "start, history=(await history_at(chain.node, start)).encode()",
        "start",
        REORGANISATIONS,
    ),
    Mutation(
        "a job that was set aside is never taken up again",
        "mesh.agent.ledger:Ledger.add_job",
        " DO UPDATE SET aside = 0 WHERE aside",
        " DO NOTHING",
        REORGANISATIONS,
    ),
    Mutation(
        "a result or match whose event a reorganisation took is waited for",
        "mesh.market._settlement:LiabilityEvents.is_confirmed",
        "missing < SETTLEMENT_LIMITS.missing_checks",
        "True",
        REORGANISATIONS,
    ),
    Mutation(
        "the provider forgets withdrawals when it is restarted",
        "mesh.market.store:Withdrawals.__enter__",
        "for identity, signer, payload, lasting in rows:",
        "for identity, signer, payload, lasting in ():",
        "crash_every,repeat_every,partition_every,withdraw",
    ),
    Mutation(
        "a success is signed although the recording lacks messages",
        "mesh.agent.jobs:Executor.finish",
        "if success and (missing :=",
        "if False and (missing :=",
        "full_every",
    ),
    Mutation(
        "a reverted payment is not asked for again",
        "mesh.agent._runtime:AgentRuntime.finalization_reverted",
        "await self._owe_result(job)",
        "pass",
        REORGANISATIONS + ",crash_every",
    ),
    Mutation(
        "the provider keeps out what it could not settle",
        "mesh.market._settlement:Settlement._not_created",
        "self._parts.forget(order)",
        "pass",
        "outage_every,unreachable",
    ),
    Mutation(
        "a result for a contract that a reorganisation took ends the provider",
        "mesh.market.provider:Arrivals._look_up_results",
        "found.get(result.message.liability)",
        "found[result.message.liability]",
        REORGANISATIONS + ",duplicate,delay",
    ),
    Mutation(
        "a transaction with an unknown outcome is sent with another nonce",
        "mesh.chain.transactions:TransactionSender._sent_before",
        "if not self._pending.abandoned:",
        "if True:",
        "lost_after_sending,leave_out,crash_every",
    ),
    Mutation(
        "a match is settled twice",
        "mesh.market._settlement:Settlement._begin",
        "self._tasks.create_task(self._create(match))",
        "[self._tasks.create_task(self._create(match)) for _ in range(2)]",
        "late",
    ),
    Mutation(
        "a result under settlement is settled again",
        "mesh.market._settlement:Results.settle",
        "if self._parts.orders.settling(order_id(result)):",
        "if False:",
        "duplicate,replay",
    ),
    Mutation(
        "an order that was used by a reverted contract is taken for withdrawn",
        "mesh.agent.ledger:Ledger.unspend",
        "SELECT {COLUMNS} FROM spent",
        "SELECT identity, kind, payload, deadline, posted, 1 FROM spent",
        REORGANISATIONS,
    ),
    Mutation(
        "that a contract is no jury is remembered for ever",
        "mesh.chain._validators:Validators._jury",
        "self._contracts.node.timing.validator_recheck if state is None else math.inf",
        "math.inf",
        "spoilt",
        seeds=100,
    ),
    Mutation(
        "a withdrawal is forgotten at the deadline of its order",
        "mesh.market._settlement:LiabilityEvents.on_head",
        "block - self._parts.chain.node.timing.reorg_depth",
        "block",
        "withdraw,short_lived,replay,repeat_every,crash_every",
        seeds=100,
    ),
    Mutation(
        "a nonce that a reorganisation freed is left to others",
        "mesh.chain.transactions:TransactionSender._use_nonces",
        "not await self._fill(nonce, waiting, was_missing=was_missing)",
        "True",
        REORGANISATIONS + ",crash_every,leave_out",
        seeds=100,
    ),
    Mutation(
        "blocks that were replaced while several were read are believed",
        "mesh.chain.following:RangeReader._read_singly",
        "if any(later",
        "if False and any(later",
        REORGANISATIONS + ",late,unreachable",
        seeds=100,
    ),
    Mutation(
        "a withdrawal that a reorganisation reverted is not made again",
        "mesh.agent.trade:Trader.reorganised",
        'self._tasks.start(self._withdraw_again(), "withdraw again on the chain")',
        "pass",
        REORGANISATIONS + ",withdraw",
        seeds=100,
    ),
    Mutation(
        "a demand whose handler met an outage of the node is not looked at again",
        "mesh.agent.demands:DemandDispatcher._decide",
        "self._drop(demand, error.code)",
        "pass",
        "unreachable,outage_every,leave,short_lived",
        seeds=100,
    ),
    Mutation(
        "an unfunded order is rejected once only",
        "mesh.market._settlement:Settlement.set_aside",
        "self.rejections.reject(order, reason, detail)",
        "pass",
        "revoke,partition_every,unreachable,outage_every",
        seeds=100,
    ),
    Mutation(
        "an order is forgotten at its deadline",
        "mesh.agent.ledger:Ledger.outbox",
        "head - self._reorg_depth",
        "head",
        REORGANISATIONS + ",short_lived,withdraw,leave",
        seeds=100,
    ),
    Mutation(
        "nonces that a reorganisation freed are never used up",
        "mesh.agent.trade:Trader._rejected",
        "order.nonce > used",
        "False",
        REORGANISATIONS + ",short_lived",
        seeds=100,
    ),
    Mutation(
        "robots leave late results to providers",
        "mesh.agent._runtime:LateResults._finalize_if_late",
        "if head < self._late_from[address]:",
        "if True:",
        "leave",
    ),
)
"""Bugs that the simulator has not found within their seeds, or for which it has not searched so far."""
