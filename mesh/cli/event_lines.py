"""What happens on a market, as lines for people and as JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec

from mesh.agent.judged_contract import verdict_words
from mesh.amounts import XRT, Unit
from mesh.cli.output import json_text, printable, short_address
from mesh.network import Reading
from mesh.watching import JobEvent, PresenceChange
from schemas import Demand, Empty, Result, String, Verified
from schemas.signing import Decline, Rejection
from schemas.verdicts import ValidatorReport

if TYPE_CHECKING:
    from mesh.watching import MarketEvent
    from schemas import Liability, Offer

LONGEST_TEXT: Final = 200
"""The most characters of a text from others that are shown."""
HASH_DIGITS: Final = 8
"""Digits of an order's hash in a line; JSON has all 64."""
EVENT_WIDTH: Final = 9
"""Columns of the event's name."""


def event_json(seen: MarketEvent | PresenceChange, *, time: str) -> dict[str, Any]:
    """An event at `time` (ISO 8601) for JSON. Amounts are text, in the smallest unit."""
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
        case Decline():
            about = {"event": "declined", "order": seen.order, "agent": seen.agent}
            about |= {"code": seen.code, "detail": seen.detail}
        case ValidatorReport():
            about = {"event": "judged", **msgspec.json.decode(seen.encode())}
        case Reading():
            about = {"event": "reading", "agent": seen.agent, "topic": seen.topic, "value": _value(seen)}
            if seen.result:
                about |= {"signer": seen.agent, "result": seen.result}
        case PresenceChange((role, address), is_present):
            about = {"event": "present" if is_present else "gone", "role": role, "agent": address}
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


class EventFormatter:
    """Formats events as lines for people. `xrt` is the address of XRT, None if unknown."""

    def __init__(self, xrt: str | None) -> None:
        self._xrt = xrt

    def line(self, seen: MarketEvent | PresenceChange) -> str:
        """The line of an event, without the time."""
        match seen:
            case Verified():
                message, kind = seen.message, type(seen.message).__name__.lower()
                words = self._result(message, seen.signer) if isinstance(message, Result) else self._order(seen)
            case Rejection():
                why = printable(seen.detail[:LONGEST_TEXT] or seen.reason[:LONGEST_TEXT])
                kind, words = "rejected", f"{seen.order[:HASH_DIGITS]} by {short_address(seen.provider)}: {why}"
            case Decline():
                why = f"{printable(seen.detail[:LONGEST_TEXT])} ({seen.code})".lstrip()
                kind, words = "declined", f"{seen.order[:HASH_DIGITS]} by {short_address(seen.agent)}: {why}"
            case ValidatorReport():
                why = printable(verdict_words(seen)[:LONGEST_TEXT])
                kind, words = "judged", f"{seen.liability} by juror {short_address(seen.juror)}: {why}"
            case Reading():
                kind, words = "reading", f"{printable(seen.topic)}  {_shown(seen)}, from {short_address(seen.agent)}"
            case PresenceChange((role, address), is_present):
                kind, words = "present" if is_present else "gone", f"{printable(role)} {address}"
            case JobEvent(_, kind, liability):
                words = self._work(liability)
        return f"{kind:<{EVENT_WIDTH}}  {words}"

    def cost(self, amount: int, token: str) -> str:
        """An amount of a token with its unit."""
        return (XRT if token == self._xrt else Unit(f"units of {short_address(token)}", 0)).show(amount)

    def _order(self, seen: Verified[Any]) -> str:
        order: Demand | Offer = seen.message
        if isinstance(order, Demand):
            does, fee = "pays", ""
        else:
            does = "works for"
            fee = f" and {XRT.show(order.lighthouse_fee)} to the provider" if order.lighthouse_fee else ""
        terms = f"{self.cost(order.cost, order.token)}{fee}, model {_short_cid(order.model)}"
        more = f"objective {_short_cid(order.objective)}, until block {order.deadline:,}"
        return f"{seen.hash.hex()[:HASH_DIGITS]}  {seen.signer} {does} {terms}, {more}"

    def _result(self, result: Result, signer: str) -> str:
        return f"{result.result}  {_ended(result.success)}, for {result.liability}, signed by {short_address(signer)}"

    def _work(self, job: Liability) -> str:
        parties = f"{short_address(job.promisor)} for {short_address(job.promisee)}, {self.cost(job.cost, job.token)}"
        return f"{job.address}  {parties}" + (f", {_ended(job.is_success)}: {job.result}" if job.result else "")


def _value(reading: Reading) -> Any:
    """The value of a reading for JSON, in which bytes become base64."""
    value = reading.value
    return value.data if isinstance(value, String) else None if isinstance(value, Empty) else value


def _shown(reading: Reading) -> str:
    value = _value(reading)
    text = value if isinstance(value, str) else json_text(value)
    return printable(text[:LONGEST_TEXT] + ("…" if len(text) > LONGEST_TEXT else ""))


def _short_cid(cid: str) -> str:
    """A CID shortened to its ends, for lines with a full one beside it."""
    return f"{cid[:6]}…{cid[-4:]}"


def _ended(success: bool) -> str:
    return "done" if success else "not done"
