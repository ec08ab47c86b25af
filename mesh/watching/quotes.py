"""Asking robots for quotes: what they want for a job, and when they would do it. They bind nobody, and cost nothing."""

from __future__ import annotations

import secrets
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from mesh.watching.market import query_all
from schemas import InvalidRecord, RpcKey
from schemas.rpc import Quote, QuoteRequest

if TYPE_CHECKING:
    from collections.abc import Collection

    import zenoh

    from mesh.network import Channel
    from schemas.signing import Signer

QUOTE_TIMEOUT: Final = 2.0
"""Seconds that robots have to answer by default."""
ASKED: Final = 64
"""Robots that are asked at once, at most."""


async def asked_quotes(
    session: zenoh.Session,
    channel: Channel,
    *,
    asker: Signer,
    robots: Collection[str],
    model: str,
    objective: str,
    token: str = "",
    timeout: float = QUOTE_TIMEOUT,
) -> list[Quote]:
    """The quotes of these `robots` (addresses) that arrive in `timeout` seconds: the cheapest first, refusals last.

    Costs are compared within a token only: those in `token` (an address) come first, then each other token's.
    """
    request = QuoteRequest(
        model=model,
        objective=objective,
        lighthouse=channel.lighthouse,
        asker=asker.address,
        nonce=secrets.token_hex(16),
        time=int(time.time()),
    ).signed_by(asker)
    keys = {str(RpcKey(robot, "quote")): robot for robot in [*robots][:ASKED]}
    found: dict[str, Quote] = {}
    for reply in await query_all(session, keys, payload=request.encode(), timeout=timeout):
        if reply.ok is None:
            continue
        with suppress(InvalidRecord):
            quote = Quote.decode(reply.ok.payload.to_bytes())
            is_asked = keys.get(str(reply.ok.key_expr)) == quote.agent and quote.request == request.identity
            if is_asked and quote.agent not in found and quote.is_signed:
                found[quote.agent] = quote
    return sorted(
        found.values(),
        key=lambda one: (bool(one.code), one.token != token, one.token, one.cost, one.start, one.agent),
    )
