"""How long a TLS router admits nobody after idle connections: those that never send a TLS handshake.

A router with a roster is a process of its own. `count` connections are opened and left alone; once Zenoh's handshake
time is over, a member connects until it is admitted. `admitted_s` is how long that took, `quiet_s` the same without
idle connections. There is no bar: Zenoh 1.10 has no setting that helps (docs/sites.md has the figures and what does).
"""

from __future__ import annotations

import socket
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import zenoh

from common import SPAWN, arguments, show

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for the sites of the tests

from mesh.identity import Member
from mesh.identity.routers import router_endpoints
from tests.support.sites import Site

HANDSHAKE: Final = 10.0
"""Seconds after which Zenoh ends a TLS handshake, by default."""
LONGEST: Final = 200.0
MEMBER: Final = "0x" + "01" * 20


def route(settings: Any, ready: Any) -> None:
    """The router's process."""
    with zenoh.open(router_endpoints(settings).config()):
        ready.set()
        time.sleep(3600)


def admitted(config: Any) -> float:
    """Seconds until a member is admitted."""
    began = time.monotonic()
    while time.monotonic() - began < LONGEST:
        try:
            with zenoh.open(config.config()):
                break
        except zenoh.ZError:
            time.sleep(0.05)
    return round(time.monotonic() - began, 2)


def measure(count: int) -> dict[str, float]:
    """Idle connections, and then a member."""
    with ExitStack() as stack:
        site = Site(Path(stack.enter_context(tempfile.TemporaryDirectory())))
        folder = site.enlist(Member(name="arm", address=MEMBER, roles=("agent",)))
        ready = SPAWN.Event()
        process = SPAWN.Process(target=route, args=(site.settings(), ready), daemon=True)
        process.start()
        stack.callback(process.terminate)
        assert ready.wait(60), "the router is not up"
        member = site.client(folder, timeout=2.0)
        quiet = admitted(member)
        for _ in range(count):
            stack.enter_context(socket.create_connection(("127.0.0.1", site.port), timeout=10))
        time.sleep(HANDSHAKE + 0.5)
        return {"idle": count, "quiet_s": quiet, "admitted_s": admitted(member)}


def main() -> None:
    """Run the benchmark."""
    options = arguments("a TLS router and idle connections", count=150)
    show(measure(options.count), as_json=options.json)


if __name__ == "__main__":
    main()
