"""What happens in a market in words, and as JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec

from mesh.cli.amounts import XRT, Unit
from mesh.cli.liability.words import short
from mesh.cli.printing import visible
from mesh.watching import JobEvent, Reading
from schemas import Demand, Empty, Result, String, Verified
from schemas.signing import Rejection

if TYPE_CHECKING:
    from mesh.watching import Seen
    from schemas import Liability, Offer

LONGEST: Final = 200
"""Letters of what somebody says that are shown."""
DIGITS: Final = 8
"""Of an order's hash in a line; with --json there are all 64."""
KIND: Final = 9
"""Letters of the longest word for what happened."""


def facts(seen: Seen | Reading, *, time: str) -> dict[str, Any]:
    """Something that happened at `time` (ISO 8601), for programs. Amounts are text, in the smallest unit."""
    match seen:
        case Verified():
            message = seen.message
            about: dict[str, Any] = {"event": type(message).__name__.lower(), "hash": seen.hash.hex()}
            about["signer"] = seen.signer
            if isinstance(message, Result):
                about |= {"liability": message.liability, "result": message.result, "success": message.success}
            else:
                about |= _order_facts(message)
        case Rejection():
            about = {"event": "rejected", "order": seen.order, "provider": seen.provider}
            about |= {"reason": seen.reason, "detail": seen.detail}
        case Reading():
            about = {"event": "reading", "signer": seen.signer, "result": seen.result, "topic": seen.topic}
            about["value"] = _value(seen)
        case JobEvent(agent, event, liability):
            about = {"event": event, "agent": agent, "liability": msgspec.json.decode(liability.encode())}
    return {"time": time} | about


def _order_facts(order: Demand | Offer) -> dict[str, Any]:
    if isinstance(order, Demand):
        fee = {"validatorFee": str(order.validator_fee)}
    else:
        fee = {"lighthouseFee": str(order.lighthouse_fee)}
    return {
        "model": order.model,
        "objective": order.objective,
        "token": order.token,
        "cost": str(order.cost),
        "lighthouse": order.lighthouse,
        "validator": order.validator,
        **fee,
        "deadline": order.deadline,
        "generation": order.generation,
    }


class Words:
    """What happened, in a line for people. `xrt` is the address of XRT, as far as it is known."""

    def __init__(self, xrt: str | None) -> None:
        self._xrt = xrt

    def line(self, seen: Seen | Reading) -> str:
        """The line, without the time."""
        match seen:
            case Verified():
                message, kind = seen.message, type(seen.message).__name__.lower()
                words = self._result(message, seen.signer) if isinstance(message, Result) else self._order(seen)
            case Rejection():
                why = visible(seen.detail[:LONGEST] or seen.reason[:LONGEST])
                kind, words = "rejected", f"{seen.order[:DIGITS]} by {short(seen.provider)}: {why}"
            case Reading():
                kind, words = "reading", f"{visible(seen.topic)}  {_shown(seen)}, from {short(seen.signer)}"
            case JobEvent(_, kind, liability):
                words = self._work(liability)
        return f"{kind:<{KIND}}  {words}"

    def cost(self, amount: int, token: str) -> str:
        """An amount of a token."""
        return (XRT if token == self._xrt else Unit(f"units of {short(token)}", 0)).show(amount)

    def _order(self, seen: Verified[Any]) -> str:
        order: Demand | Offer = seen.message
        if isinstance(order, Demand):
            does, fee = "pays", ""
        else:
            does = "works for"
            fee = f" and {XRT.show(order.lighthouse_fee)} to the provider" if order.lighthouse_fee else ""
        terms = f"{self.cost(order.cost, order.token)}{fee}, model {_short_cid(order.model)}"
        more = f"objective {_short_cid(order.objective)}, until block {order.deadline:,}"
        return f"{seen.hash.hex()[:DIGITS]}  {seen.signer} {does} {terms}, {more}"

    def _result(self, result: Result, signer: str) -> str:
        return f"{result.result}  {_ended(result.success)}, for {result.liability}, signed by {short(signer)}"

    def _work(self, job: Liability) -> str:
        parties = f"{short(job.promisor)} for {short(job.promisee)}, {self.cost(job.cost, job.token)}"
        return f"{job.address}  {parties}" + (f", {_ended(job.is_success)}: {job.result}" if job.result else "")


def _value(reading: Reading) -> Any:
    """What was read as JSON has it; bytes become base64."""
    match reading.value:
        case Empty():
            return None
        case String(data):
            return data
        case value:
            return value


def _shown(reading: Reading) -> str:
    value = _value(reading)
    text = value if isinstance(value, str) else msgspec.json.encode(value).decode()
    return visible(text[:LONGEST] + ("…" if len(text) > LONGEST else ""))


def _short_cid(cid: str) -> str:
    """A CID in a line in which something else is the one to copy."""
    return f"{cid[:6]}…{cid[-4:]}"


def _ended(success: bool) -> str:
    return "done" if success else "not done"
