"""The page in Chromium while the market moves: 1,000 orders a second for a minute, from a process of their own.

Router, chain, page server, sender and browser are processes on this machine. The orders are signed before. `p99_ms` is
from the moment before an order is put on Zenoh until the frame in which its row is first on the screen; the page shows
the latest orders ten times a second, so it skips some. `first_view_ms` is from the navigation to the whole market view,
before the orders come. `tab_mb` and `server_mb` are the most resident memory, of the tab's process and the server, and
`tab_cpu` and `server_cpu` the share of a core that each takes, which says more than times on a busy machine.

Bars: at most 150 kB of gzip, at least 30 frames a second, p99 at most 250 ms, first view at most 1 s; and between the
second and the last quarter neither memory grows by more than a tenth and 5 MB. The exit status is 1 if one is missed.
"""

from __future__ import annotations

import asyncio
import gzip
import os
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import AsyncExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from common import SPAWN, arguments, installed_anvil, router, show, unsigned_demands

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # `tests` has the browser, `peers` finds it

from mesh.dev.development import serve_chain
from mesh.network import Endpoints, Network, message_key
from mesh.settings import Settings
from peers.catalog import locate
from schemas import Signer, encode, verify
from tests.web.browser import Browser

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mesh.dev.development import DevelopmentChain

PACE: Final = 1000
"""Orders a second."""
TOGETHER: Final = 0.01
"""Seconds between two bursts of the sender: no timer of a busy machine is finer."""
DEADLINE: Final = 6000
"""Blocks that the orders are valid."""
PATIENCE: Final = 120.0
WARM_UP: Final = 3.0
"""Seconds of orders before anything is measured."""
GZIP_BAR, FPS_BAR, P99_BAR, VIEW_BAR = 150_000, 30.0, 250.0, 1000.0
GROWTH_BAR: Final = 1.1
STEADY_MB: Final = 5.0
STATIC: Final = Path(__file__).resolve().parents[1] / "bridges" / "web" / "static"

VIEW: Final = """
(() => {
  const look = () => {
    if (document.querySelector("table.ticker") && !document.querySelector("[aria-busy=true]"))
      window.benchView = performance.now();
    else requestAnimationFrame(look);
  };
  requestAnimationFrame(look);
})();
"""
WATCH: Final = """
const bench = window.bench = { frames: 0, since: performance.now(), seen: [] };
const known = new Set();
const look = () => {
  bench.frames++;
  const now = performance.timeOrigin + performance.now();
  for (const link of document.querySelectorAll("table.ticker a")) {
    const order = link.href.slice(-64, -48);
    if (known.has(order)) break;
    known.add(order);
    bench.seen.push([order, now]);
  }
  requestAnimationFrame(look);
};
requestAnimationFrame(look);
"""
SAW: Final = "return { fps: 1000 * bench.frames / (performance.now() - bench.since), seen: bench.seen }"


class Watched(NamedTuple):
    """What the browser saw."""

    first_view_ms: float
    fps: float
    seen: list[tuple[str, float]]
    """The first 16 digits of an order's hash, and when it was on the screen, Unix milliseconds."""
    tab_mb: list[float]
    server_mb: list[float]
    tab_cpu: float
    """Processor time of the tab for a second of the measurement."""
    server_cpu: float


def send(endpoint: str, lighthouse: str, name: str, count: int, *signals: Any) -> None:
    """The sender's process: signs, says `ready`, waits for `begin`, and puts when it sent each order into `sent`."""
    asyncio.run(_send(endpoint, lighthouse, name, count, *signals))


async def _send(
    endpoint: str, lighthouse: str, name: str, count: int, deadline: int, ready: Any, begin: Any, sent: Any
) -> None:
    people = [Signer(os.urandom(32)) for _ in range(16)]
    signed = [
        people[number % 16].sign(demand)
        for number, demand in enumerate(unsigned_demands(count, deadline=deadline, lighthouse=lighthouse))
    ]
    wire = [(message_key(name, demand), encode(demand)) for demand in signed]
    hashes = [verify(payload).hash.hex()[:16] for _, payload in wire]
    times: list[float] = []
    async with Network(Endpoints(connect=(endpoint,))) as network:
        ready.set()
        await asyncio.to_thread(begin.wait)
        began = time.monotonic()
        while len(times) < count:
            for key, payload in wire[len(times) : int((time.monotonic() - began) * PACE)]:
                times.append(time.time() * 1000)
                network.session.put(key, payload)
            await asyncio.sleep(TOGETHER)
    sent.put(dict(zip(hashes, times, strict=True)))


async def measure(seconds: int) -> dict[str, Any]:
    """Run it on a market of its own."""
    async with AsyncExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        endpoint, _ = stack.enter_context(router())
        served = await stack.enter_async_context(
            serve_chain(Settings(data_dir=folder), host="127.0.0.1", port=0, block_time=1.0, anvil=installed_anvil())
        )
        deployment = served.market.deployment
        async with served.market.chain(served.url, "person") as chain:
            deadline = await chain.block_number() + DEADLINE
        server, url = stack.enter_context(page_server(endpoint, served, folder))
        ready, begin, sent = SPAWN.Event(), SPAWN.Event(), SPAWN.Queue()
        count = int((seconds + WARM_UP) * PACE)
        about = (endpoint, deployment.lighthouse, deployment.lighthouse_name, count, deadline, ready, begin, sent)
        sender = SPAWN.Process(target=send, args=about, daemon=True)
        sender.start()
        stack.callback(sender.terminate)
        assert await asyncio.to_thread(ready.wait, PATIENCE + seconds), "the sender is not ready"
        watched = await asyncio.to_thread(watch, url, server.pid, begin, seconds)
        times = await asyncio.to_thread(sent.get, True, PATIENCE)
    return judged(watched, times, seconds)


@contextmanager
def page_server(endpoint: str, served: DevelopmentChain, folder: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """`aira web` as a process, and its address."""
    deployment = served.market.deployment
    values = {"connect": endpoint, "web3-http-provider": served.url, "ens-contract": deployment.ens}
    values |= {"lighthouse-contract": deployment.lighthouse_name, "data-dir": f"{folder}/page", "log-level": "error"}
    options = [word for name, value in values.items() for word in (f"--{name}", value)]
    words = [sys.executable, "-u", "-m", "mesh", "web", "--listen", "127.0.0.1:0", *options]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        yield process, process.stdout.readline().split()[-1]
    finally:
        process.terminate()
        process.wait()


def watch(url: str, server: int, begin: Any, seconds: int) -> Watched:
    """Look at the market view while the orders come."""
    with Browser(url) as browser:
        browser.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": VIEW})
        browser.go("market")
        browser.sees("Live")
        view = browser.driver.execute_script("return window.benchView")
        begin.set()
        time.sleep(WARM_UP)
        browser.driver.execute_script(WATCH)
        tab = _tab_of(browser.driver.service.process.pid)
        tab_mb, server_mb, tab_cpu, server_cpu = [], [], _cpu(tab), _cpu(server)
        began = time.monotonic()
        while time.monotonic() < began + seconds:
            time.sleep(0.5)
            tab_mb.append(_resident_mb(tab))
            server_mb.append(_resident_mb(server))
        took = time.monotonic() - began
        tab_cpu, server_cpu = (_cpu(tab) - tab_cpu) / took, (_cpu(server) - server_cpu) / took
        saw = browser.driver.execute_script(SAW)
    seen = [(order, at) for order, at in saw["seen"]]
    return Watched(view, saw["fps"], seen, tab_mb, server_mb, tab_cpu, server_cpu)


def judged(watched: Watched, times: dict[str, float], seconds: int) -> dict[str, Any]:
    """The results with the bars that they miss."""
    late = [at - times[order] for order, at in watched.seen if order in times]
    results = {
        "bundle_gzip_bytes": sum(len(gzip.compress(file.read_bytes(), mtime=0)) for file in STATIC.iterdir()),
        "fps": round(watched.fps, 1),
        "p99_ms": round(statistics.quantiles(late, n=100)[-1], 1) if len(late) > 1 else float("inf"),
        "first_view_ms": round(watched.first_view_ms, 1),
        "tab_mb": round(max(watched.tab_mb), 1),
        "server_mb": round(max(watched.server_mb), 1),
    }
    missed = [f"{name} is {results[name]}" for name, bar in _MOST.items() if results[name] > bar]
    missed += [f"fps is {results['fps']}"] if results["fps"] < FPS_BAR else []
    span = (max(times.values()) - min(times.values())) / 1000
    if (pace := len(times) / span) < 0.95 * PACE:
        missed.append(f"the sender sent {pace:.0f} orders a second")
    for name, sizes in (("tab", watched.tab_mb), ("server", watched.server_mb)):
        quarter = len(sizes) // 4
        before, after = statistics.median(sizes[quarter : 2 * quarter]), statistics.median(sizes[-quarter:])
        results[f"{name}_growth"] = round(after / before, 3)
        if seconds >= 40 and after > before * GROWTH_BAR + STEADY_MB:
            missed.append(f"the memory of the {name} grew from {before:.0f} to {after:.0f} MB")
    p50 = round(statistics.median(late or [0.0]), 1)
    about = {"p50_ms": p50, "tab_cpu": round(watched.tab_cpu, 2), "server_cpu": round(watched.server_cpu, 2)}
    return results | about | {"shown": len(late), "sent": len(times), "missed": missed}


_MOST: Final = {"bundle_gzip_bytes": GZIP_BAR, "p99_ms": P99_BAR, "first_view_ms": VIEW_BAR}


def _resident_mb(pid: int) -> float:
    """The resident memory of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def _cpu(pid: int) -> float:
    """Seconds of processor time that a process has used."""
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def _tab_of(driver: int) -> int:
    """The process of the tab: the largest renderer among the descendants of the driver."""
    parents, renderers = {}, []
    for folder in Path("/proc").iterdir():
        if not folder.name.isdigit():
            continue
        try:
            parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            if b"--type=renderer" in (folder / "cmdline").read_bytes():
                renderers.append(int(folder.name))
        except OSError:
            continue  # it ended
    return max((pid for pid in renderers if driver in _ancestors(pid, parents)), key=_resident_mb)


def _ancestors(pid: int, parents: dict[int, int]) -> Iterator[int]:
    while pid := parents.get(pid, 0):
        yield pid


if __name__ == "__main__":
    options = arguments(__doc__.splitlines()[0], seconds=60)
    locate("chromium")
    results = asyncio.run(measure(options.seconds))
    show(results, as_json=options.json)
    sys.exit(bool(results["missed"]))
