"""What the page gets to see of liabilities, results and tokens, as JSON: amounts are decimal texts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec

from mesh.chain import NoContracts, Reverted
from mesh.cli.liability import liability_json as record_json
from mesh.errors import ChainError
from mesh.flood import BoundedDict

if TYPE_CHECKING:
    from mesh.chain import Chain
    from schemas import Liability, Result, Verified

TOKENS: Final = 1024


class Labels:
    """How tokens call themselves, by address. Only the address can be trusted."""

    def __init__(self, chain: Chain) -> None:
        self._chain = chain
        self._known: BoundedDict[str, dict[str, Any]] = BoundedDict(TOKENS)

    async def learn(self, token: str) -> dict[str, Any]:
        """The label of a token; asked of the chain once. A contract that is no token has an empty one."""
        if token not in self._known:
            try:
                info = await self._chain.tokens.info(token)
            except (NoContracts, Reverted):
                self._known[token] = self.of(token)
            except ChainError:
                return self.of(token)
            else:
                self._known[token] = {"address": info.address, "symbol": info.symbol, "decimals": info.decimals}
        return self._known[token]

    def of(self, token: str) -> dict[str, Any]:
        """The label, as far as it is known."""
        return self._known.get(token) or {"address": token, "symbol": "", "decimals": 0}


def liability_json(liability: Liability, labels: Labels) -> dict[str, Any]:
    """A liability with its state and the label of its token."""
    return record_json(liability) | {"token": labels.of(liability.token)}


def result_json(seen: Verified[Result]) -> dict[str, Any]:
    """A signed result."""
    fields: dict[str, Any] = msgspec.to_builtins(seen.message)
    return fields | {"signer": seen.signer}
