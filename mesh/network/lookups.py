"""What validation knows of the market and asks its chain: ENS names, deadlines, and validators of orders."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Generic, NamedTuple, Protocol, TypeVar

from mesh.clock import SYSTEM_CLOCK
from mesh.errors import InvalidMessage
from mesh.flood import BoundedDict
from schemas import ZERO_ADDRESS, Demand, Offer, Result, SignedMessage, Withdrawal, names_in

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable

    from mesh.clock import Clock

    Resolver = Callable[[str], Awaitable[str]]

M = TypeVar("M", bound=SignedMessage)

AMBIGUOUS_NONCE: Final = "00" * 12
"""No nonce of generation 3 may start like this: the contracts would read it as a generation-5 order."""
KEPT: Final = 60.0
"""Seconds for which the address of a name is used."""
FAILURE_KEPT: Final = 10.0
"""Seconds for which a name that could not be resolved is not asked about again."""
NAMES: Final = 4096
"""Names that are remembered; the oldest are forgotten first."""


class Unresolved(NamedTuple, Generic[M]):
    """A message about which the chain has to be asked first: it contains ENS names, without which it can't be hashed
    and verified, or is verified and names a validator that is not known yet."""

    message: M
    key: str
    fingerprint: int
    signer: str = ""
    """The signer of a verified message."""

    @property
    def question(self) -> str:
        """What has to be asked, `name` or `validator`: the reason of its rejection if that fails."""
        return "name" if names_in(self.message) else "validator"


class ValidatorCheck(Protocol):
    """Which validators (EIP-55 addresses) orders may name: `chain.validators`."""

    def known(self, validator: str) -> bool | None:
        """Whether orders may name it; None if that has to be asked."""

    async def is_safe(self, validator: str) -> bool:
        """The same, asked. Raises `ChainError`."""


class MarketRules:
    """What the orders and withdrawals of a market must fit; parameters as of `MessageValidator`. Thread-safe."""

    def __init__(self, address: str | None, head: Callable[[], int], validators: ValidatorCheck | None) -> None:
        self._address = address
        self._head = head
        self._validators = validators

    def check(self, order: SignedMessage) -> bool:
        """Whether nothing has to be asked about its validator. Raises `InvalidMessage` for what can't be used."""
        if type(order) is Result:  # not `isinstance`, which is slow when it fails
            return True
        if type(order) is not Withdrawal and order.sender is None and str(order.nonce).startswith(AMBIGUOUS_NONCE):
            raise InvalidMessage("nonce", "the contracts would take it for the sender of a generation-5 order")
        if (head := self._head()) and order.deadline <= head:
            raise InvalidMessage("deadline", f"block {order.deadline} has passed")
        if self._address is not None and order.lighthouse != self._address:
            raise InvalidMessage("lighthouse", f"made for {order.lighthouse}, not for this market")
        if self._validators is None or type(order) is Withdrawal or order.validator == ZERO_ADDRESS:
            return True
        is_safe = self._validators.known(order.validator)
        if is_safe is False:
            raise InvalidMessage("validator", f"{order.validator} is a lighthouse, or could become one")
        return is_safe is not None

    async def ask(self, message: SignedMessage) -> None:
        """Ask about the validator of an order, so that `check` knows it afterwards. Raises `AiraError`."""
        if self._validators is not None and isinstance(message, Demand | Offer):
            await self._validators.is_safe(message.validator)


class NameCache:
    """Addresses of ENS names by `resolver`, which is asked about a name once in a while. `known` is thread-safe."""

    def __init__(self, resolver: Resolver, *, clock: Clock = SYSTEM_CLOCK) -> None:
        self._resolver = resolver
        self._clock = clock
        self._answers: BoundedDict[str, tuple[float, str]] = BoundedDict(NAMES)

    def known(self, names: Iterable[str]) -> dict[str, str] | None:
        """The addresses of these names, without asking; None if one has to be asked.

        Raises `InvalidMessage` (`name`) if one could not be resolved a moment ago.
        """
        now, found = self._clock.monotonic(), {}
        for name in names:
            until, address = self._answers.get(name, (0.0, ""))
            if until <= now:
                return None
            if not address:
                raise InvalidMessage("name", f"{name} could not be resolved a moment ago")
            found[name] = address
        return found

    async def addresses(self, names: Iterable[str]) -> dict[str, str]:
        """The addresses of these names. Raises `AiraError`."""
        return {name: await self._address(name) for name in names}

    async def _address(self, name: str) -> str:
        if (known := self.known((name,))) is not None:
            return known[name]
        address, kept = "", FAILURE_KEPT
        try:
            address, kept = await self._resolver(name), KEPT
        finally:
            self._answers[name] = self._clock.monotonic() + kept, address
        return address
