"""What the page gets to see of orders, liabilities, results and tokens, as JSON: amounts are decimal texts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec

from mesh.chain import NoContracts, Reverted
from mesh.cli.liability import liability_json as record_json
from mesh.errors import ChainError
from mesh.flood import BoundedDict

if TYPE_CHECKING:
    from bridges.web.contracts import SeenJob
    from bridges.web.market import SeenOrder
    from mesh.chain import Chain
    from schemas import Liability, Result, Verified

TOKENS: Final = 1024
AMOUNTS: Final = ("cost", "validatorFee", "lighthouseFee")


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


def order_json(order: SeenOrder) -> dict[str, Any]:
    """An order with its hash and its signer."""
    message = order.verified.message
    fields: dict[str, Any] = msgspec.to_builtins(message)
    fields |= {name: str(fields[name]) for name in AMOUNTS if name in fields}
    fields |= {"nonce": str(fields["nonce"]), "sender": fields.get("sender"), "generation": message.generation}
    return {"hash": order.hash, "kind": message.kind, "signer": order.verified.signer, "at": order.at} | fields


def liability_json(liability: Liability, labels: Labels) -> dict[str, Any]:
    """A liability with its state and the label of its token."""
    return record_json(liability) | {"token": labels.of(liability.token)}


def result_json(seen: Verified[Result]) -> dict[str, Any]:
    """A signed result."""
    fields: dict[str, Any] = msgspec.to_builtins(seen.message)
    return fields | {"signer": seen.signer}


class AccountRecord(msgspec.Struct):
    """What the chain says of an account's jobs, as far as they were read: amounts are those of one token."""

    created: int = 0
    done: int = 0
    failed: int = 0
    open: int = 0
    earned: int = 0
    spent: int = 0

    def json(self) -> dict[str, Any]:
        """The record of a promisor."""
        return {
            "created": self.created,
            "done": self.done,
            "failed": self.failed,
            "open": self.open,
            "earned": str(self.earned),
        }


def records_of(jobs: list[SeenJob], token: str) -> dict[str, AccountRecord]:
    """The record of each account: jobs as promisor, and what it spent as promisee in `token`."""
    found: dict[str, AccountRecord] = {}
    for job in jobs:
        liability = job.liability
        record = found.setdefault(liability.promisor, AccountRecord())
        record.created += 1
        record.open += not liability.is_finalized
        record.failed += liability.is_finalized and not liability.is_success
        record.done += liability.is_success
        if liability.is_success and liability.token == token:
            record.earned += liability.cost
            found.setdefault(liability.promisee, AccountRecord()).spent += liability.cost
    return found
