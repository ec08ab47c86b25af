"""Zenoh routers for tests: one inside this process, and the stand-alone program."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any, Final, Self

import zenoh

from mesh.network.endpoints import SEND_WAIT, Endpoints
from mesh.ops.identity.routers import nested
from tests.support.peers import require
from tests.support.ports import answers, free_port
from tests.support.processes import Server
from tests.support.waiting import wait_until

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

OPEN_MILLISECONDS: Final = 30_000
WAIT_MICROSECONDS: Final = round(SEND_WAIT * 1e6)


class EmbeddedRouter:
    """A Zenoh session in mode `router` inside this process: no peer to install, up in milliseconds.

    `stop` and `start` simulate an outage: the router returns on the same port. Both block for some milliseconds.
    """

    def __init__(self, port: int | None = None) -> None:
        self.port = port or free_port()
        self.endpoint = f"tcp/127.0.0.1:{self.port}"
        self._session: zenoh.Session | None = None

    @property
    def session(self) -> zenoh.Session | None:
        """The router's own session while it runs."""
        return self._session

    def start(self) -> None:
        """Open the session; clients may connect when this returns."""
        if self._session is not None:
            raise RuntimeError("this router runs already")
        self._session = zenoh.open(zenoh.Config.from_json5(json.dumps(_router_config(self.endpoint, {}))))

    def stop(self) -> None:
        """Close the session and all its connections. Nothing happens if it is not open."""
        session, self._session = self._session, None
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.stop()

    async def __aenter__(self) -> Self:
        return await asyncio.to_thread(self.__enter__)

    async def __aexit__(self, *exc_info: object) -> None:
        await asyncio.to_thread(self.stop)


class Zenohd(Server):
    """The stand-alone router as a process. `config` is added to its configuration: access control, TLS, limits."""

    name = "zenohd"

    def __init__(self, *, port: int | None = None, config: Mapping[str, Any] | None = None) -> None:
        self._program: Path = require("zenohd")
        super().__init__()
        self.port = port or free_port()
        self.endpoint = f"tcp/127.0.0.1:{self.port}"
        self._config = dict(config or {})

    def command(self) -> Sequence[str | Path]:
        file = self.folder / "zenohd.json5"
        file.write_text(json.dumps(_router_config(self.endpoint, self._config)))
        return [self._program, "--config", file]

    def is_ready(self) -> bool:
        return answers(self.port)


def client_config(endpoint: str) -> zenoh.Config:
    """The configuration of a client of the router at `endpoint`, which queues and waits as the product's clients do."""
    config = Endpoints(connect=(endpoint,)).config()
    # The product's clients try again after a shorter time, `zenoh.open` does not.
    config.insert_json5("transport/unicast/open_timeout", str(OPEN_MILLISECONDS))
    return config


def wait_until_declared(endpoint: str, key: str, *, answers: bool = False) -> None:
    """Return when another client of the router finds a subscriber on a key, or with `answers` a queryable."""
    with zenoh.open(client_config(endpoint)) as other:
        asking: Any = other.declare_querier(key) if answers else other.declare_publisher(key)
        wait_until(lambda: asking.matching_status.matching, what=f"a declaration on {key}")
        asking.undeclare()


def _router_config(endpoint: str, more: Mapping[str, Any]) -> dict[str, Any]:
    """As the product's routers, but they wait as long as clients for room in a queue: no test has a client too slow.

    Gossip is off, so that tests running at the same time do not find each other's routers.
    """
    config = nested(Endpoints(mode="router", listen=(endpoint,)).options())
    config["scouting"]["gossip"] = {"enabled": False}
    config["transport"]["link"]["tx"]["queue"]["congestion_control"] = {"drop": {"wait_before_drop": WAIT_MICROSECONDS}}
    return {**config, **more}
