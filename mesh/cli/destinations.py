"""Where a recording is played again: a device, the topics of its job, or any keys."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final, Protocol

import zenoh
from msgspec import Struct

from mesh.cli.opening import own_address
from mesh.errors import ConfigurationError, InputError
from schemas.key_chunks import topic_chunks
from schemas.keys import DeviceTopicKey, LiabilityTopicKey, ObjectiveTopicKey

if TYPE_CHECKING:
    from mesh.settings import Settings

ADDRESS: Final = re.compile(r"0x[0-9a-fA-F]{40}")


class Destination(Protocol):
    """Where messages go."""

    def key(self, topic: str, role: str) -> str:
        """The key for a topic, and the role that a message has there. Raises `InvalidKey` for what no key may hold."""


class DeviceTopics(Struct, frozen=True):
    """The topics of a device, outside any job."""

    agent: str
    device: str

    def key(self, topic: str, role: str) -> str:
        """Its topic."""
        return str(DeviceTopicKey(self.agent, self.device, topic))


class JobTopics(Struct, frozen=True):
    """The topics of a job that has ended."""

    agent: str
    liability: str

    def key(self, topic: str, role: str) -> str:
        """Where it was when it was recorded."""
        family = ObjectiveTopicKey if role == "objective" else LiabilityTopicKey
        return str(family(self.agent, self.liability, topic))


class Below(Struct, frozen=True):
    """Keys that begin with `prefix`."""

    prefix: str

    def key(self, topic: str, role: str) -> str:
        """Its topic."""
        return self.prefix + topic_chunks(topic)


def destination_of(settings: Settings, to: str) -> Destination:
    """Where `--to` says. Raises `InputError`, `ConfigurationError`."""
    first, slash, rest = to.partition("/")
    if not slash:
        own = own_address(settings)
        if own is None:
            raise ConfigurationError(
                f"whose device {to!r} is can't be told without an account",
                hint="give --keyfile, or --to ADDRESS/DEVICE",
            )
        return _checked(DeviceTopics(own, to))
    if ADDRESS.fullmatch(first) and "/" not in rest:
        return _checked(DeviceTopics(first, rest))
    try:
        prefix = str(zenoh.KeyExpr(to))
    except zenoh.ZError as error:
        raise InputError(f"{to!r} is not the beginning of a key: {error}") from None
    if "*" in prefix or "$" in prefix:
        raise InputError(f"{to!r} has a wildcard, and would reach everybody", hint="name one key")
    return Below(prefix)


def _checked(device: DeviceTopics) -> DeviceTopics:
    """The same, if keys can be made with it. Raises `InvalidKey`."""
    device.key("/any", "")
    return device
