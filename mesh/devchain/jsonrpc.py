"""JSON-RPC 2.0 as Ethereum nodes speak it: quantities, data, errors.

Quantities are hexadecimal without leading zeros (`0x0`, `0x1f`), data is hexadecimal with two digits a byte
(`0x`, `0x01ff`); both as in the execution API specification.
"""

from __future__ import annotations

from typing import Any, Final

PARSE_ERROR: Final = -32700
INVALID_REQUEST: Final = -32600
METHOD_NOT_FOUND: Final = -32601
INVALID_PARAMS: Final = -32602
INTERNAL_ERROR: Final = -32603
SERVER_ERROR: Final = -32000
REVERTED: Final = 3
"""The code that geth and anvil give to a call which the contract reverted; `data` is then what it reverted with."""


class RpcError(Exception):
    """An error that goes to the caller of the JSON-RPC method, not to ours."""

    def __init__(self, code: int, message: str, *, data: str | None = None) -> None:
        super().__init__(message)
        self.code = code
        self.message = message
        self.data = data

    def as_object(self) -> dict[str, Any]:
        """The `error` member of a response."""
        error: dict[str, Any] = {"code": self.code, "message": self.message}
        if self.data is not None:
            error["data"] = self.data
        return error


def parse_quantity(value: object) -> int:
    """A quantity of the parameters as an int. Raises `RpcError` (invalid params)."""
    if isinstance(value, int) and not isinstance(value, bool) and value >= 0:
        return value
    if isinstance(value, str) and value.startswith("0x"):
        try:
            return int(value, 16)
        except ValueError:
            pass
    raise RpcError(INVALID_PARAMS, f"{str(value)[:80]!r} is not a quantity (0x…)")


def parse_data(value: object, *, length: int | None = None) -> bytes:
    """Data of the parameters as bytes, of `length` bytes where given. Raises `RpcError` (invalid params)."""
    data: bytes | None = None
    if isinstance(value, bytes):
        data = bytes(value)
    elif isinstance(value, str) and value.startswith("0x"):
        try:
            data = bytes.fromhex(value[2:])
        except ValueError:
            data = None
    if data is None or (length is not None and len(data) != length):
        size = "" if length is None else f" of {length} bytes"
        raise RpcError(INVALID_PARAMS, f"{str(value)[:80]!r} is not data{size} (0x…)")
    return data


def to_json(value: Any) -> Any:
    """A value of the node as JSON-RPC has it: ints as quantities, bytes as data, keys in camel case."""
    match value:
        case None | bool() | str():
            return value
        case int():
            return hex(value)
        case bytes():
            return "0x" + value.hex()
        case dict():
            return {camel(name): to_json(member) for name, member in value.items()}
        case list() | tuple():
            return [to_json(member) for member in value]
    raise TypeError(f"no JSON-RPC form of {type(value).__name__}")


def camel(name: str) -> str:
    """`block_number` → `blockNumber`."""
    head, *rest = name.split("_")
    return head + "".join(part.capitalize() for part in rest)
