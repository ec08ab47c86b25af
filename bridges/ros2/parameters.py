"""Parameters of nodes in a ROS 2 system."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from bridges.ros2.errors import RosCallFailed
from schemas.errors import InvalidPayload

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

_FIELDS: Final = (
    "",
    "bool_value",
    "integer_value",
    "double_value",
    "string_value",
    "byte_array_value",
    "bool_array_value",
    "integer_array_value",
    "double_array_value",
    "string_array_value",
)
"""The field that holds a value, by the number of its type (rcl_interfaces/ParameterType)."""
_KINDS: Final[dict[type, int]] = {bool: 1, int: 2, float: 3, str: 4}
_ARRAYS: Final[dict[type, int]] = {bool: 6, int: 7, float: 8, str: 9}


class RosParameters:
    """The parameters of a node: `await robot.parameters("/talker").get("rate")`.

    A value is a bool, int, float, str, bytes or a list of one of the first four; None stands for a parameter that is
    not set. Every method raises `RosUnavailable` or `RosCallFailed` if the node does not answer.
    """

    def __init__(self, node_name: str, call: Callable[[str, str, dict[str, Any]], Awaitable[Any]]) -> None:
        self.node_name: Final = node_name
        self._call = call

    async def get(self, name: str) -> Any:
        """The value of a parameter."""
        return (await self.get_all(name))[name]

    async def get_all(self, *names: str) -> dict[str, Any]:
        """The values of parameters, by name."""
        reply = await self._call("get_parameters", "GetParameters", {"names": list(names)})
        if len(reply.values) != len(names):  # a node answers with no values if one parameter is not declared
            return await self._one_by_one(names)
        return {name: from_value(value) for name, value in zip(names, reply.values, strict=True)}

    async def set(self, **values: Any) -> None:
        """Set parameters. Raises `RosCallFailed` with the node's reason if it refuses one.

        Names with dots go in a dict: `set(**{"camera.rate": 5})`.
        """
        parameters = [{"name": name, "value": to_value(value)} for name, value in values.items()]
        reply = await self._call("set_parameters", "SetParameters", {"parameters": parameters})
        refused = [
            f"{name}: {result.reason}"
            for name, result in zip(values, reply.results, strict=False)
            if not result.successful
        ]
        if refused or len(reply.results) != len(values):
            raise RosCallFailed(f"{self.node_name}/set_parameters", "; ".join(refused) or "it did not set all")

    async def list(self) -> tuple[str, ...]:
        """The names of the parameters."""
        reply = await self._call("list_parameters", "ListParameters", {})
        return tuple(str(name) for name in reply.result.names)

    async def _one_by_one(self, names: tuple[str, ...]) -> dict[str, Any]:
        if len(names) == 1:
            return {names[0]: None}
        return {name: await self.get(name) for name in names}


def from_value(value: Any) -> Any:
    """The Python value of a rcl_interfaces/ParameterValue; None if it is not set or of a type that is not known."""
    if not 0 < value.type < len(_FIELDS):
        return None
    found = getattr(value, _FIELDS[value.type])
    if _FIELDS[value.type] == "byte_array_value":
        return bytes(found)
    return [*getattr(found, "tolist", lambda: found)()] if value.type > len(_KINDS) else found


def to_value(value: Any) -> dict[str, Any]:
    """The fields of a rcl_interfaces/ParameterValue. Raises `InvalidPayload` for a value that has none."""
    if value is None:
        return {}
    if isinstance(value, bytes):
        return {"type": 5, "byte_array_value": value}
    if isinstance(value, list | tuple):
        kinds = {type(one) for one in value}
        if kinds == {int, float}:
            kinds = {float}
        number = _ARRAYS.get(kinds.pop() if len(kinds) == 1 else str if not kinds else object, 0)
        value = [*value]
    else:
        number = _KINDS.get(type(value), 0)
    if not number:
        raise InvalidPayload("rcl_interfaces/msg/ParameterValue", f"{value!r} is of no type that a parameter has")
    return {"type": number, _FIELDS[number]: value}
