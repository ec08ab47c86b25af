"""The validator, which users write or run: policies, checks of their own, and `run`."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from mesh.amounts import XRT
from mesh.base.log_context import log_event
from mesh.errors import ClosedError
from mesh.role.program import RESEND, OpenRole, Program
from mesh.settings import load
from mesh.validator.judging import COMPLETE, Policy, invalid_policy, own_policy, policy_of
from schemas.verdicts import VERDICT_LIMITS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from contextlib import AsyncExitStack

    from mesh.base.retry import RetryPolicy
    from mesh.chain import Account, Chain
    from mesh.settings import Settings
    from mesh.validator.judging import CheckFunction
    from mesh.validator.runtime import ValidatorRuntime

    F = TypeVar("F", bound=CheckFunction)

log = logging.getLogger(__name__)


class Validator(Program):
    """Judges the results of liabilities that name it: `validator = Validator()`, then `validator.run()`.

    In generation 5 it is a juror of the `contract` (ENS name or address), in generation 3 the account itself. It judges
    by the shipped `policies`, of which `complete` is always one, and by its own checks (see `check`). A liability that
    pays less than `fee` (`"0.1 XRT"`, or wn) does not count. What is not given is taken from the settings, which are
    loaded if they are not given either. It opens nothing before `run` or `async with`. `account` and `chain` (open)
    are used instead of those that the settings name; `resend` is how often verdicts without effect are sent again.
    Raises `ConfigurationError`, `InvalidAmount`.
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
        settings = settings if contract is None else replace(settings, validator_contract=contract)
        super().__init__(settings, account=account, chain=chain)
        self.fee = XRT.amount(settings.validator_fee if fee is None else fee)
        """The least fee, wn."""
        self.name = (settings.validator_title if title is None else title)[: VERDICT_LIMITS.text]
        self._policies: list[Policy] = [COMPLETE]
        for text in settings.validator_policies if policies is None else policies:
            self._add(policy_of(text))
        self._resend = resend
        self._runtime: ValidatorRuntime | None = None

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
        default the setting `validator_check_timeout`), the result is not judged. Raises `ConfigurationError`.
        """
        seconds = self.settings.validator_check_timeout if timeout is None else timeout

        def register(function: F) -> F:
            self._add(own_policy(name, description, function, seconds))
            return function

        return register

    async def _open_role(self, stack: AsyncExitStack, account: Account | None) -> OpenRole:
        from mesh.validator.runtime import ValidatorRuntime, judging  # loads the chain

        assert account is not None
        make = partial(
            judging,
            self.settings,
            account,
            self._given_chain,
            policies=self.policies,
            fee=self.fee,
            title=self.name,
            drops=self.drops,
        )
        parts = await self._open_when_ready(stack, make)
        self._place = parts.directory
        runtime = self._runtime = await stack.enter_async_context(ValidatorRuntime(parts, resend=self._resend))
        contract, names = parts.court.contract, ",".join(policy.name for policy in self.policies)
        facts = log_event("validator-started", account=account.address, contract=contract, zenoh_id=parts.network.id)
        who = f"{account.address}{' for ' + contract if contract else ''}"
        log.info("validator %s on %s judges by %s", who, parts.channel.lighthouse, names, extra=facts)
        return OpenRole(runtime.measure, runtime.status.health, runtime.tasks)

    def _add(self, policy: Policy) -> None:
        if policy == COMPLETE:
            return  # it is always there
        # Shipped ones may be there several times, with other options.
        if any(known == policy or (policy.is_own and known.name == policy.name) for known in self._policies):
            raise invalid_policy(policy.name, "it is given twice")
        if len(self._policies) >= VERDICT_LIMITS.policies:
            raise invalid_policy(policy.name, f"a validator has {VERDICT_LIMITS.policies} policies at most")
        self._policies.append(policy)

    def _closed(self) -> None:
        self._runtime = None
