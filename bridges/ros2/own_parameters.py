"""Parameters of our own node, which other nodes read and set."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from bridges.ros2.parameters import from_value, to_value

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    Handler = Callable[[Any], Awaitable[object]]

NOT_SET: Final = 0
"""The type of a parameter that does not exist (rcl_interfaces/ParameterType)."""


class RosOwnParameters:
    """The parameters that our node declares; `values` has them by name.

    `refusal` is asked about a new value and says why it is refused; with an empty text it is taken. A parameter keeps
    its type.
    """

    def __init__(self, values: Mapping[str, Any], refusal: Callable[[str, Any], str]) -> None:
        self._types = {name: int(to_value(value)["type"]) for name, value in values.items()}
        self._refusal = refusal
        self.values: Final = dict(values)

    def services(self) -> dict[str, tuple[str, Handler]]:
        """The type and the handler of each service, by its name below the node's."""
        return {
            "get_parameters": ("GetParameters", self._get),
            "get_parameter_types": ("GetParameterTypes", self._get_types),
            "describe_parameters": ("DescribeParameters", self._describe),
            "list_parameters": ("ListParameters", self._list),
            "set_parameters": ("SetParameters", self._set),
            "set_parameters_atomically": ("SetParametersAtomically", self._set_atomically),
        }

    async def _get(self, request: Any) -> object:
        if any(name not in self.values for name in request.names):
            return {"values": []}  # as rclcpp answers
        return {"values": [to_value(self.values[name]) for name in request.names]}

    async def _get_types(self, request: Any) -> object:
        return {"types": [self._types.get(name, NOT_SET) for name in request.names]}

    async def _describe(self, request: Any) -> object:
        return {"descriptors": [{"name": name, "type": self._types.get(name, NOT_SET)} for name in request.names]}

    async def _list(self, request: Any) -> object:
        prefixes = tuple(f"{prefix}." for prefix in request.prefixes)
        named = [name for name in self.values if not prefixes or name in request.prefixes or name.startswith(prefixes)]
        return {"result": {"names": named, "prefixes": sorted({name.rpartition(".")[0] for name in named} - {""})}}

    async def _set(self, request: Any) -> object:
        return {"results": [self._apply([parameter]) for parameter in request.parameters]}

    async def _set_atomically(self, request: Any) -> object:
        return {"result": self._apply(request.parameters)}

    def _apply(self, parameters: list[Any]) -> dict[str, Any]:
        """Take new values, all or none."""
        changes = {str(one.name): from_value(one.value) for one in parameters}
        for one in parameters:
            name = str(one.name)
            if name not in self.values:
                return {"successful": False, "reason": f"there is no parameter {name}"}
            if one.value.type != self._types[name]:
                return {"successful": False, "reason": f"{name} has another type"}
            if why := self._refusal(name, changes[name]):
                return {"successful": False, "reason": why}
        self.values.update(changes)
        return {"successful": True, "reason": ""}
