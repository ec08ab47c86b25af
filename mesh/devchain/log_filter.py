"""Which logs are asked for: the `address` and `topics` of a log query, as the execution API specifies them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mesh.devchain.jsonrpc import INVALID_PARAMS, RpcError, parse_data

if TYPE_CHECKING:
    from collections.abc import Sequence


class LogFilter:
    """Of any of several addresses, with any of several topics in each place; what is not given accepts anything.

    Raises `RpcError` for a query that is none.
    """

    def __init__(self, query: object) -> None:
        if not isinstance(query, dict):
            raise RpcError(INVALID_PARAMS, "a query of logs is an object with address and topics")
        addresses, places = query.get("address") or [], query.get("topics") or []
        if not isinstance(places, list | tuple):
            raise RpcError(INVALID_PARAMS, "the topics of a query of logs are a list")
        self._addresses = {_hex(parse_data(address, length=20)) for address in _alternatives(addresses)}
        self._topics: Sequence[set[str] | None] = [
            None if place is None else {_hex(parse_data(topic, length=32)) for topic in _alternatives(place)}
            for place in places
        ]

    def accepts(self, log: dict[str, Any]) -> bool:
        """Whether a log, as JSON-RPC has it, is asked for."""
        if self._addresses and log["address"] not in self._addresses:
            return False
        if len(self._topics) > len(log["topics"]):
            return False
        places = zip(log["topics"], self._topics, strict=False)
        return all(wanted is None or topic in wanted for topic, wanted in places)


def _alternatives(value: Any) -> list[Any]:
    """A member of a log query as the list of what it accepts."""
    return list(value) if isinstance(value, list | tuple) else [value]


def _hex(data: bytes) -> str:
    return "0x" + data.hex()
