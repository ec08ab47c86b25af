"""The page in Chromium while the market moves: 1,000 orders a second for a minute, from a process of their own.

First the market is in view. Then it is a job, while the orders go on: its robot publishes 200 messages a second on the
topics of the job: numbers, positions, texts, and one picture a second.

Router, chain, page server, sender, robot and browser are processes on this machine. The orders are signed before. Times
are from the moment before something is put on Zenoh until the frame in which it is first on the screen. `p99_ms` is of
the orders that were shown: the page shows the latest ten times a second, so it skips some. `live_p99_ms` is of all the
job's numbers and texts: until the frame that has one, or a later one of its topic. `first_view_ms` is from the
navigation to the whole view: of the market before the orders come, of the job while its messages do. `tab_mb` and
`server_mb` are the most resident memory, of the tab's process and the server, and `tab_cpu` and `server_cpu` the share
of a core that each takes, which says more than times on a busy machine.

Bars, in both views: at most 150 kB of gzip, at least 55 frames a second, p99 at most 250 ms, first view at most 1 s;
and between the second and the last quarter neither memory grows by more than a tenth and 5 MB. The exit status is 1 if
one is missed.
"""

from __future__ import annotations

import asyncio
import gzip
import os
import secrets
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from common import SPAWN, arguments, installed_anvil, process, router, show, unsigned_demands

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # `tests` has the browser, `peers` finds it

from mesh import Agent
from mesh.dev.development import serve_chain
from mesh.network import Endpoints, Network, message_key
from mesh.recording import pack_values
from mesh.settings import Settings
from peers.catalog import locate
from schemas import ZERO_ADDRESS, Demand, Offer, Signer, cid_of_file, encode, verify
from schemas.model import parse_description
from tests.support.web.browser import Browser

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from mesh.agent.handlers import Job
    from mesh.dev.development import DevelopmentChain

ROOT: Final = Path(__file__).resolve().parents[1]
PACE: Final = 1000
"""Orders a second."""
LIVE: Final = {"/position": 70, "/load": 100, "/arm": 20, "/said": 9, "/camera": 1}
"""Messages a second on each topic of the job."""
COUNTED: Final = {"/load": ".plotted .figure", "/said": ".lines bdi"}
"""The topics whose messages are numbered, and where their panels show the last one."""
TOGETHER: Final = 0.01
"""Seconds between two bursts of a sender: no timer of a busy machine is finer."""
DEADLINE: Final = 6000
"""Blocks that the orders are valid."""
PATIENCE: Final = 120.0
WARM_UP: Final = 3.0
"""Seconds of messages before anything is measured."""
GZIP_BAR, FPS_BAR, P99_BAR, VIEW_BAR = 150_000, 55.0, 250.0, 1000.0
GROWTH_BAR: Final = 1.1
STEADY_MB: Final = 5.0
STATIC: Final = ROOT / "bridges" / "web" / "static"

VIEW: Final = """
(() => {
  const look = () => {
    if (document.querySelector("table.ticker, .track canvas") && !document.querySelector("[aria-busy=true]"))
      window.benchView = performance.now();
    else requestAnimationFrame(look);
  };
  requestAnimationFrame(look);
})();
"""
WATCH: Final = """
const [topics] = arguments;
const bench = window.bench = { frames: 0, since: performance.now(), seen: [] };
const known = new Set();
const isNew = (name) => !known.has(name) && known.add(name);
const panel = (topic) =>
  [...document.querySelectorAll(".track")].find((one) => one.querySelector("code").innerText === topic);
const look = () => {
  bench.frames++;
  const now = performance.timeOrigin + performance.now();
  for (const link of document.querySelectorAll("table.ticker a")) {
    const order = link.href.slice(-64, -48);
    if (!isNew(order)) break;
    bench.seen.push([order, now]);
  }
  for (const [topic, place] of Object.entries(topics)) {
    const shown = `${topic} ${panel(topic)?.querySelector(place)?.textContent.replace(/\\D/g, "")}`;
    if (isNew(shown)) bench.seen.push([shown, now]);
  }
  requestAnimationFrame(look);
};
document.querySelector(".tracks")?.scrollIntoView();
requestAnimationFrame(look);
"""
SAW: Final = "return { fps: 1000 * bench.frames / (performance.now() - bench.since), seen: bench.seen }"


class Watched(NamedTuple):
    """What the browser saw."""

    first_view_ms: float
    fps: float
    seen: list[tuple[str, float]]
    """What was on the screen (the first 16 digits of an order's hash, or a topic and a number), and when, Unix
    milliseconds."""
    tab_mb: list[float]
    server_mb: list[float]
    tab_cpu: float
    """Processor time of the tab for a second of the measurement."""
    server_cpu: float


def send(endpoint: str, lighthouse: str, name: str, count: int, *signals: Any) -> None:
    """The sender's process: signs, says `ready`, and after each of `begins` sends `count` orders.

    When it sent each of them it puts into `sent`.
    """
    asyncio.run(_send(endpoint, lighthouse, name, count, *signals))


async def _send(
    endpoint: str, lighthouse: str, name: str, count: int, deadline: int, ready: Any, begins: Any, sent: Any
) -> None:
    people = [Signer(os.urandom(32)) for _ in range(16)]
    signed = [
        people[number % 16].sign(demand)
        for number, demand in enumerate(unsigned_demands(count * len(begins), deadline=deadline, lighthouse=lighthouse))
    ]
    wire = [(message_key(name, demand), encode(demand)) for demand in signed]
    hashes = [verify(payload).hash.hex()[:16] for _, payload in wire]
    async with Network(Endpoints(connect=(endpoint,))) as network:
        ready.set()
        for place, begin in enumerate(begins):
            own = slice(place * count, (place + 1) * count)
            times: list[float] = []
            await asyncio.to_thread(begin.wait)
            began = time.monotonic()
            while len(times) < count:
                for key, payload in wire[own][len(times) : int((time.monotonic() - began) * PACE)]:
                    times.append(time.time() * 1000)
                    network.session.put(key, payload)
                await asyncio.sleep(TOGETHER)
            sent.put(dict(zip(hashes[own], times, strict=True)))


def work(settings: Settings, model: Path, objective: Path, ready: Any, done: Any, sent: Any) -> None:
    """The robot's process: says `ready`, does one job until `done`, and puts into `sent` when it published what."""
    asyncio.run(_work(settings, model, objective, ready, done, sent))


async def _work(settings: Settings, model: Path, objective: Path, ready: Any, done: Any, sent: Any) -> None:
    robot = Agent(cid_of_file(model), settings=settings)

    @robot.on("/drive", dict)
    async def drive(job: Job, _order: dict[str, Any]) -> None:
        began, times, counts = time.monotonic(), {}, dict.fromkeys(LIVE, 0)
        while not done.is_set():
            for topic, pace in LIVE.items():
                for number in range(counts[topic], int((time.monotonic() - began) * pace)):
                    times[f"{topic} {number}"] = time.time() * 1000
                    job.publish(topic, _message(topic, number))
                    counts[topic] += 1
            await asyncio.sleep(TOGETHER)
        sent.put(times)

    async with robot:
        for file in (model, objective):
            await robot.add(file)
        while (await robot.parts.ledger.cursor())[0] is None:  # it listens from that block on
            await asyncio.sleep(TOGETHER)
        ready.set()
        await asyncio.Event().wait()


def _message(topic: str, number: int) -> object:
    if topic == "/position":
        return {"x": number % 700 / 100, "y": number % 450 / 100, "theta": number % 628 / 100}
    if topic == "/arm":
        return {"joints": [(number + joint * 10) % 90 for joint in range(6)]}
    return {"/load": number, "/said": f"step {number}", "/camera": picture(number)}[topic]


def picture(number: int, *, width: int = 160, height: int = 120) -> bytes:
    """A bitmap of 58 kB."""
    pixels = bytes((number * 20 + place) % 256 for place in range(3 * width)) * height
    return struct.pack("<2s6I2H6I", b"BM", 54 + len(pixels), 0, 54, 40, width, height, 1, 24, *(0,) * 6) + pixels


async def measure(seconds: int) -> dict[str, Any]:
    """Run it on a market of its own."""
    async with AsyncExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        os.environ["TMPDIR"] = folder  # what Chromium leaves goes with it
        endpoint, _ = stack.enter_context(router())
        served = await stack.enter_async_context(
            serve_chain(Settings(data_dir=folder), host="127.0.0.1", port=0, block_time=1.0, anvil=installed_anvil())
        )
        deployment = served.market.deployment
        async with served.market.chain(served.url, "person") as chain:
            deadline = await chain.block_number() + DEADLINE
        server, url = stack.enter_context(page_server(endpoint, served, folder))
        ready, begins, sent = SPAWN.Event(), (SPAWN.Event(), SPAWN.Event()), SPAWN.Queue()
        count = int((seconds + WARM_UP) * PACE)
        about = (endpoint, deployment.lighthouse, deployment.lighthouse_name, count, deadline, ready, begins, sent)
        sender = SPAWN.Process(target=send, args=about, daemon=True)
        sender.start()
        stack.callback(sender.terminate)
        assert await asyncio.to_thread(ready.wait, PATIENCE + 2 * seconds), "the sender is not ready"
        market = await asyncio.to_thread(watch, url, "market", server.pid, begins[0], seconds)
        orders = [await asyncio.to_thread(sent.get, True, PATIENCE)]
        async with working(served, endpoint, Path(folder)) as (job, done, published):
            live = await asyncio.to_thread(watch, url, f"job/{job}", server.pid, begins[1], seconds)
            done.set()
            messages = await asyncio.to_thread(published.get, True, PATIENCE)
        orders.append(await asyncio.to_thread(sent.get, True, PATIENCE))
    return judged(market, live, orders, messages, seconds)


@asynccontextmanager
async def working(served: DevelopmentChain, endpoint: str, folder: Path) -> AsyncIterator[tuple[str, Any, Any]]:
    """A robot at work: the address of its job, the event that ends it, and the queue that then gets what it sent."""
    model, objective = folder / "model.json", folder / "objective.mcap"
    model.write_bytes(parse_description((ROOT / "tests" / "web" / "model.json").read_bytes()).encode())
    pack_values([("/drive", {"metres": 2, "seconds": 2, "direction": "left"})], objective)
    deployment = served.market.deployment
    settings = Settings(
        connect=(endpoint,),
        web3_http_provider=served.url,
        ens_contract=deployment.ens,
        lighthouse_contract=deployment.lighthouse_name,
        data_dir=str(folder / "robot"),
        keyfile=str(served.keys / "robot.json"),
        keyfile_password_file=str(served.keys / "password"),
    )
    ready, done, published = SPAWN.Event(), SPAWN.Event(), SPAWN.Queue()
    with process(work, settings, model, objective, ready, done, published):
        assert await asyncio.to_thread(ready.wait, PATIENCE), "the robot is not ready"
        async with served.market.chain(served.url, "provider") as chain:
            terms: dict[str, Any] = {
                "model": cid_of_file(model),
                "objective": cid_of_file(objective),
                "token": deployment.xrt,
                "cost": 0,
            }
            terms |= {"lighthouse": deployment.lighthouse, "validator": ZERO_ADDRESS, "nonce": secrets.token_hex(32)}
            terms |= {"deadline": await chain.block_number() + DEADLINE}
            person, robot = (served.market.accounts[role].signer for role in ("person", "robot"))
            demand, offer = person.sign(Demand(**terms, validator_fee=0)), robot.sign(Offer(**terms, lighthouse_fee=0))
            created = await chain.liabilities.create(deployment.lighthouse_name, demand, offer)
        yield created.liability, done, published


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


def watch(url: str, route: str, server: int, begin: Any, seconds: int) -> Watched:
    """Look at a view while the orders come."""
    with Browser(url) as browser:
        browser.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": VIEW})
        browser.go(route)
        browser.sees("Live")
        view = browser.until(lambda: browser.driver.execute_script("return window.benchView"), "the whole view")
        begin.set()
        time.sleep(WARM_UP)
        browser.driver.execute_script(WATCH, COUNTED)
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
    return Watched(view, saw["fps"], [*map(tuple, saw["seen"])], tab_mb, server_mb, tab_cpu, server_cpu)


def judged(
    market: Watched, live: Watched, orders: list[dict[str, float]], messages: dict[str, float], seconds: int
) -> dict[str, Any]:
    """The results with the bars that they miss."""
    results: dict[str, Any] = {
        "bundle_gzip_bytes": sum(len(gzip.compress(file.read_bytes(), mtime=0)) for file in STATIC.iterdir())
    }
    missed = [f"the files have {results['bundle_gzip_bytes']} bytes"] if results["bundle_gzip_bytes"] > GZIP_BAR else []
    shown = [at - orders[0][order] for order, at in market.seen if order in orders[0]]
    for name, watched, late in (("", market, shown), ("live_", live, delays(live.seen, messages))):
        of_phase, misses = _of(watched, late, seconds)
        results |= {f"{name}{what}": value for what, value in of_phase.items()}
        missed += [f"{name}{miss}" for miss in misses]
    sent = {"orders": (orders[0], PACE), "orders beside the job": (orders[1], PACE)}
    for what, (times, pace) in (sent | {"messages of the job": (messages, sum(LIVE.values()))}).items():
        span = (max(times.values()) - min(times.values())) / 1000
        if (reached := len(times) / span) < 0.95 * pace:
            missed.append(f"{reached:.0f} {what} were sent a second")
    return results | {"missed": missed}


def delays(seen: list[tuple[str, float]], sent: dict[str, float]) -> list[float]:
    """Milliseconds from each of the counted messages that were sent meanwhile to what shows it, or a later one."""
    found = []
    for topic in COUNTED:
        shown = [(int(number), at) for name, at in seen for of, _, number in [name.partition(" ")] if of == topic]
        for place in range(1, len(shown)):
            (before, _), (number, at) = shown[place - 1 : place + 1]
            found += [at - sent[f"{topic} {one}"] for one in range(before + 1, number + 1)]
    return found


def _of(watched: Watched, late: list[float], seconds: int) -> tuple[dict[str, Any], list[str]]:
    """The results of one view, and what it misses."""
    results: dict[str, Any] = {
        "fps": round(watched.fps, 1),
        "p50_ms": round(statistics.median(late or [0.0]), 1),
        "p99_ms": round(statistics.quantiles(late, n=100)[-1], 1) if len(late) > 1 else float("inf"),
        "first_view_ms": round(watched.first_view_ms, 1),
        "shown": len(late),
    }
    missed = [f"{what} is {results[what]}" for what in ("p99_ms", "first_view_ms") if results[what] > _MOST[what]]
    missed += [f"fps is {results['fps']}"] if results["fps"] < FPS_BAR else []
    for name, sizes in (("tab", watched.tab_mb), ("server", watched.server_mb)):
        quarter = len(sizes) // 4
        before, after = statistics.median(sizes[quarter : 2 * quarter]), statistics.median(sizes[-quarter:])
        results |= {f"{name}_mb": round(max(sizes), 1), f"{name}_growth": round(after / before, 3)}
        if seconds >= 40 and after > before * GROWTH_BAR + STEADY_MB:
            missed.append(f"memory of the {name} grew from {before:.0f} to {after:.0f} MB")
    return results | {"tab_cpu": round(watched.tab_cpu, 2), "server_cpu": round(watched.server_cpu, 2)}, missed


_MOST: Final = {"p99_ms": P99_BAR, "first_view_ms": VIEW_BAR}


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
