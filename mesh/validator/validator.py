"""The validator, which users write or run: policies, checks of their own, and `run`."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from mesh.amounts import XRT
from mesh.background import Background
from mesh.composition import load_account
from mesh.errors import ClosedError
from mesh.flood import Drops
from mesh.log_context import LogSource, log_event, source_context
from mesh.role import Lifecycle
from mesh.settings import load
from mesh.starting import open_when_ready, serve_on_each_chain, wait_for_files
from mesh.telemetry.logs import set_process_source
from mesh.telemetry.serving import Telemetry
from mesh.validator.policies import COMPLETE, policy_of
from mesh.validator.policy import InvalidPolicy, OwnPolicy, Policy
from mesh.work.outbox import RESEND
from schemas.verdicts import LONGEST_TEXT, MOST_POLICIES

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from contextlib import AsyncExitStack
    from pathlib import Path

    from mesh.chain import Account, Chain
    from mesh.retry import RetryPolicy
    from mesh.settings import Settings
    from mesh.validator.policy import CheckFunction
    from mesh.validator.runtime import ValidatorRuntime

    F = TypeVar("F", bound=CheckFunction)

log = logging.getLogger(__name__)


class Validator(Lifecycle):
    """Judges the results of liabilities that name it: `validator = Validator()`, then `validator.run()`.

    In generation 5 it is a juror of the `contract` (ENS name or address), in generation 3 the account itself. It judges
    by the shipped `policies`, of which `complete` is always one, and by its own checks (see `check`). A liability that
    pays less than `fee` (`"0.1 XRT"`, or wn) does not count. What is not given is taken from the settings, which are
    loaded if they are not given either. It opens nothing before `run` or `async with`. `account` and `chain` (open)
    are used instead of those that the settings name; `resend` is how often verdicts without effect are sent again.
    Raises `InvalidPolicy`, `InvalidAmount`.
    """

    title = "validator"

    def __init__(
        self,
        contract: str | None = None,
        *,
        settings: Settings | None = None,
        policies: Sequence[str] | None = None,
        fee: str | int | None = None,
        title: str | None = None,
        account: Account | None = None,
        chain: Chain | None = None,
        resend: RetryPolicy = RESEND,
    ) -> None:
        settings = load() if settings is None else settings
        self.settings = settings if contract is None else replace(settings, validator_contract=contract)
        self.fee = XRT.amount(settings.validator_fee if fee is None else fee)
        """The least fee, wn."""
        self.name = (settings.validator_title if title is None else title)[:LONGEST_TEXT]
        self._policies: list[Policy] = [COMPLETE]
        for text in settings.validator_policies if policies is None else policies:
            self._add(policy_of(text))
        self._account = account
        self._given_chain = chain
        self._resend = resend
        self._runtime: ValidatorRuntime | None = None
        self.telemetry = Telemetry(self.settings.metrics_listen)
        """Serves its metrics and its health if the settings say where."""
        self.drops = Drops()
        """Counts what was dropped, of what strangers sent."""

    @property
    def policies(self) -> tuple[Policy, ...]:
        """The policies by which it judges."""
        return tuple(self._policies)

    @property
    def runtime(self) -> ValidatorRuntime:
        """The working side of a running validator. Raises `ClosedError` if it is not running."""
        if self._runtime is None:
            raise ClosedError("the validator is not running", hint="use it inside `async with`")
        return self._runtime

    @property
    def address(self) -> str:
        """The address of its account (EIP-55)."""
        return self.runtime.parts.signer.address

    def check(self, name: str, *, description: str, timeout: float | None = None) -> Callable[[F], F]:
        """Judge by a function, too: `@validator.check("quick-lamp", description="It answers within 1 s.")`.

        The function gets the `Evidence`, and returns True if the work counts, or False, or a text that says why it does
        not. It may also yield several texts. It runs in a thread. `name` is a word (letters, digits, hyphens);
        `description` is what parties read before they name this validator. If it takes more than `timeout` seconds (by
        default the setting `validator_check_timeout`), the result is not judged. Raises `InvalidPolicy`.
        """
        seconds = self.settings.validator_check_timeout if timeout is None else timeout

        def register(function: F) -> F:
            self._add(OwnPolicy(name, description, function, seconds))
            return function

        return register

    def run(self) -> None:
        """Serve until Ctrl-C or SIGTERM. Prints errors that people can fix in one line, with exit code 1 or 2."""
        from mesh.running import run_until_stopped

        run_until_stopped(self.serve, settings=self.settings, role="validator")

    async def serve(self) -> None:
        """Serve until cancelled, also when a development chain is started afresh."""
        place: Path | None = None

        async def on_one_chain(settings: Settings) -> None:
            nonlocal place
            self.settings = settings
            async with self:
                place = self.runtime.parts.directory
                await asyncio.Event().wait()

        if self._given_chain is None:
            await serve_on_each_chain(self.settings, on_one_chain, place=lambda: place)
        else:
            await on_one_chain(self.settings)

    async def _open(self, stack: AsyncExitStack) -> None:
        stack.callback(self._closed)
        await stack.enter_async_context(self.telemetry)
        await wait_for_files(self.settings)
        account = self._account
        if account is None:
            account = await asyncio.to_thread(load_account, self.settings)
        source = LogSource("validator", account.address, self.settings.lighthouse_contract.lower())
        set_process_source(source)
        with source_context(source):
            await self._open_as(stack, account)

    async def _open_as(self, stack: AsyncExitStack, account: Account) -> None:
        from mesh.validator.components import ValidatorTerms, judging  # these load the chain
        from mesh.validator.runtime import ValidatorRuntime

        terms = ValidatorTerms(policies=self.policies, fee=self.fee, title=self.name)

        make = partial(judging, self.settings, account, self._given_chain, terms=terms, drops=self.drops)
        parts = await open_when_ready(stack, self.settings, make, role="validator", on_wait=self.telemetry.starting)
        self._runtime = await stack.enter_async_context(ValidatorRuntime(parts, resend=self._resend))
        names = ",".join(policy.name for policy in self.policies)
        facts = log_event(
            "validator-started", account=account.address, contract=parts.bench.contract, zenoh_id=parts.network.id
        )
        who = f"{account.address}{' for ' + parts.bench.contract if parts.bench.contract else ''}"
        log.info("validator %s on %s judges by %s", who, parts.channel.lighthouse, names, extra=facts)
        stack.enter_context(self.telemetry.showing(measure=self._runtime.measure, health=self._runtime.health))
        tasks = await stack.enter_async_context(Background())
        tasks.start(self._runtime.run(), "runtime")
        tasks.start(self.drops.run(), "drops")

    def _add(self, policy: Policy) -> None:
        if policy == COMPLETE:
            return  # it is always there
        own = isinstance(policy, OwnPolicy)  # others may be there several times, with other options
        if any(known == policy or (own and known.name == policy.name) for known in self._policies):
            raise InvalidPolicy(policy.name, "it is given twice")
        if len(self._policies) >= MOST_POLICIES:
            raise InvalidPolicy(policy.name, f"a validator has {MOST_POLICIES} policies at most")
        self._policies.append(policy)

    def _closed(self) -> None:
        self._runtime = None
