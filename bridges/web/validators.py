"""What the page says of a validator before a demand that names it is signed: its jurors' signed announcements."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aiohttp import web
from msgspec.structs import replace

from bridges.web.answers import amount, answer
from mesh.cli.demand_validator import JudgedTerms
from mesh.cli.errors import DoubtfulValidator

if TYPE_CHECKING:
    from bridges.web.components import WebComponents
    from schemas.verdicts import ValidatorAnnouncement


class ValidatorApi:
    """The handler for validators."""

    def __init__(self, parts: WebComponents) -> None:
        self._parts = parts

    def routes(self) -> list[web.RouteDef]:
        """Its route."""
        return [web.get("/api/v1/validators/{validator}", self.validator)]

    async def validator(self, request: web.Request) -> web.Response:
        fee = request.query.get("fee", "")
        judged = await _judged(self._parts, request.match_info["validator"], amount(fee) if fee else None)
        signed = [_signed(one) for one in judged.announced.announcements]
        return answer(judged.json() | {"refund": judged.refund, "announcements": signed})


async def require_judged(parts: WebComponents, validator: str, fee: int | None) -> int:
    """The fee (wn) of a demand that names a validator (address or name); by default what it announces.

    Raises `DoubtfulValidator` if perhaps nobody judges, `UnsafeValidator` and its like, `ChainError`.
    """
    judged = await _judged(parts, validator, fee)
    if judged.doubts:
        raise DoubtfulValidator(f"not posted: {judged.reasons}", hint="name another validator, or order without one")
    return judged.fee


async def _judged(parts: WebComponents, validator: str, fee: int | None) -> JudgedTerms:
    return await JudgedTerms.of(
        parts.chain,
        parts.validators,
        await parts.chain.names.address(validator),
        lighthouse=parts.lighthouse,
        generation=parts.settings.generation,
        fee=fee,
    )


def _signed(announcement: ValidatorAnnouncement) -> dict[str, Any]:
    """An announcement as the text that its juror has signed, so that a browser can check it."""
    text = replace(announcement, signature="").encode().decode()
    return {"juror": announcement.juror, "text": text, "signature": announcement.signature}
