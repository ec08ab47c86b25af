"""How long a TLS router admits nobody because of idle connections: those that never send a TLS handshake.

A router with a roster is a process of its own. `count` connections from 127.0.0.2 are opened and left alone; meanwhile,
until Zenoh's handshake time is over, a member connects from 127.0.0.1 again and again. `admitted_s` is the longest time
that took, `quiet_s` the same without idle connections. There is no bar: Zenoh 1.10 has no setting that helps. With
`--firewall docs` the rules in docs/guides/floods.md apply, for which root runs it in a network of its own:

    unshare -n sh -c 'ip link set lo up; python bench/idle_tls.py --count 1200 --firewall docs'
"""

from __future__ import annotations

import re
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import zenoh

from common import SPAWN, arguments, show

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for the sites of the tests

from mesh.ops.identity import Member
from mesh.ops.identity.routers import router_endpoints
from tests.support.sites import Site

HANDSHAKE: Final = 10.0
"""Seconds after which Zenoh ends a TLS handshake, by default."""
LONGEST: Final = 200.0
FLOODER: Final = "127.0.0.2"
RULES: Final = Path(__file__).resolve().parents[1] / "docs" / "guides" / "floods.md"
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


def rules(port: int) -> str:
    """The rules of the documentation, for this port."""
    found = re.search(r"^    table inet aira \{\n.*?^    \}\n", RULES.read_text(), re.MULTILINE | re.DOTALL)
    assert found is not None
    return found[0].replace("7447", str(port))


def idle(port: int) -> socket.socket:
    """A connection that may not be answered."""
    opened = socket.socket()
    opened.setblocking(False)
    opened.bind((FLOODER, 0))
    opened.connect_ex(("127.0.0.1", port))
    return opened


def measure(count: int, firewall: str) -> dict[str, float]:
    """Idle connections, and a member beside them."""
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
        if firewall == "docs":
            subprocess.run(["nft", "-f", "-"], input=rules(site.port), text=True, check=True)
        for _ in range(count):
            stack.enter_context(idle(site.port))
        taken, until = [], time.monotonic() + HANDSHAKE + 5
        while time.monotonic() < until:
            taken.append(admitted(member))
            time.sleep(1.0)
        return {"idle": count, "quiet_s": quiet, "admitted_s": max(taken)}


def main() -> None:
    """Run the benchmark."""
    options = arguments("a TLS router and idle connections", count=150, firewall=("none", "docs"))
    show(measure(options.count, options.firewall), as_json=options.json)


if __name__ == "__main__":
    main()
