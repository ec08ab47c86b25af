"""Whether a router heeds an identity: who may do nothing is told so by nobody, since what is denied just vanishes."""

from __future__ import annotations

import asyncio
from contextlib import ExitStack
from typing import TYPE_CHECKING, Final

from mesh.errors import RemoteError
from mesh.network import Network, call_in_loop
from schemas.keys import DeviceTopicKey

if TYPE_CHECKING:
    import zenoh

    from mesh.network import Endpoints

SECONDS: Final = 5.0
"""Seconds in which the router would have passed on what it heeds."""


class NotAdmittedYet(RemoteError):
    """The identity with this `address` was let in, and nothing that it does has an effect."""

    code = "not-heeded"

    def __init__(self, address: str) -> None:
        super().__init__(
            f"the router lets {address} in, and heeds nothing that it does: it is not in the roster, or revoked",
            hint="ask the site's operator; `aira router acl --check --roster FILE` says who may do what",
        )
        self.address = address


async def check_standing(endpoints: Endpoints, address: str, *, agent: str = "", device: str = "") -> None:
    """Return when the router has let in this identity and passes on what it does.

    Tried with a subscription below the own address, as every role but `edge` may have; for that one below the device
    `device` of the agent at `agent`. Raises `NotAdmittedYet`, `NotAdmitted`, `NetworkUnavailable`, `InvalidKey`.
    """
    keys = [str(DeviceTopicKey(address, "check", "/check"))]
    if agent:
        keys.append(str(DeviceTopicKey(agent, device, "/check")))
    async with Network(endpoints) as one, Network(endpoints) as other:
        with ExitStack() as declared:
            heeded, loop = asyncio.Event(), asyncio.get_running_loop()

            def changed(status: zenoh.MatchingStatus) -> None:
                if status.matching:
                    call_in_loop(loop, heeded.set)

            for key in keys:
                publisher = declared.enter_context(other.session.declare_publisher(key))
                publisher.declare_matching_listener(changed)
                declared.enter_context(one.session.declare_subscriber(key, lambda sample: None))
            try:
                async with asyncio.timeout(SECONDS):
                    await heeded.wait()
            except TimeoutError:
                raise NotAdmittedYet(address) from None
