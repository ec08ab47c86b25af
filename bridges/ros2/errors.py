"""What can go wrong between the mesh and a ROS 2 system."""

from __future__ import annotations

from mesh.errors import ConfigurationError, InputError, RemoteError


class InvalidRosName(InputError, code="invalid-ros-name"):
    """A text is not the name of a ROS 2 topic, service, node or type."""

    def __init__(self, text: str, why: str) -> None:
        super().__init__(f"{text[:160]!r} is not a name in ROS 2: {why}")
        self.text = text


class InvalidRosToken(InputError, code="invalid-ros-token"):
    """A key is not the liveliness token of a ROS 2 node, publisher, subscription, server or client."""

    def __init__(self, text: str, why: str) -> None:
        super().__init__(f"{text[:160]!r} is not a liveliness token of ROS 2: {why}")
        self.text = text


class RosNotAllowed(ConfigurationError, code="ros-not-allowed"):
    """A topic or service of the ROS 2 system is not among those that may be used; `use` says how it was to be used."""

    def __init__(self, name: str, use: str) -> None:
        super().__init__(f"{name}: not allowed to {use}", hint=f"allow it: RosAllowed({use}=({name!r},))")
        self.name = name
        self.use = use


class TooManyRosEndpoints(InputError, code="too-many-ros-endpoints"):
    """Another topic or service would need one publisher or client more than a robot may have."""

    def __init__(self, name: str, limit: int) -> None:
        super().__init__(f"{name}: this robot has {limit} publishers or clients already")
        self.name = name


class RosUnavailable(RemoteError, code="ros-unavailable"):
    """Nothing in the ROS 2 system publishes, subscribes to or serves a name."""

    def __init__(self, name: str, timeout: float) -> None:
        super().__init__(
            f"{name}: nothing in the ROS 2 system has this name after {timeout:g} s",
            hint="compare the domain and the router with those of the robot (ROS_DOMAIN_ID, rmw_zenohd)",
        )
        self.name = name


class RosTypeMismatch(RemoteError, code="ros-type-mismatch"):
    """The ROS 2 system uses a name with another type, or with another definition of the type (its hash differs)."""

    def __init__(self, name: str, here: str, there: str) -> None:
        super().__init__(f"{name}: its type is {there} in the ROS 2 system, and {here} here")
        self.name = name
        self.here = here
        self.there = there


class RosCallFailed(RemoteError, code="ros-call-failed"):
    """A service of the ROS 2 system gave no reply in time, or an unusable one."""

    def __init__(self, name: str, why: str) -> None:
        super().__init__(f"{name}: {why}")
        self.name = name


class RosGoalFailed(RemoteError, code="ros-goal-failed"):
    """The goal of an action was rejected, aborted or cancelled by its server; `status` says which.

    `result` is the decoded result of a goal that was accepted.
    """

    def __init__(self, name: str, status: str, result: object = None) -> None:
        super().__init__(f"{name}: the goal was {status}")
        self.name = name
        self.status = status
        self.result = result
