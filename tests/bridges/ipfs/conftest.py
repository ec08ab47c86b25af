"""Two daemons of one kind in one swarm, shared by all tests; each test uses its own topic."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from itertools import count
from typing import TYPE_CHECKING

import pytest

from tests.support.ipfs import JsIpfs, Kubo, LibraryNode
from tests.support.ipfs_bridge.legacy import LegacyClient

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator

KINDS: dict[str, type[JsIpfs | Kubo]] = {"js-ipfs": JsIpfs, "kubo": Kubo}
_topics = count(1)


@dataclass(frozen=True)
class Swarm:
    """Two daemons; `b` knows `a` after `join`."""

    a: JsIpfs | Kubo
    b: JsIpfs | Kubo

    async def join(self) -> None:
        """Connect them, until one of them stops."""
        async with LegacyClient(self.b.api) as client:
            await client.call("swarm/connect", ("arg", self.a.swarm_address))


@pytest.fixture(scope="package", params=KINDS)
def kind(request: pytest.FixtureRequest) -> type[JsIpfs | Kubo]:
    """The kind of daemon: js-ipfs, and a current Kubo."""
    return KINDS[request.param]


@pytest.fixture(scope="package")
def swarms() -> Iterator[Callable[[type[JsIpfs | Kubo]], Swarm]]:
    """Starts two daemons of a kind, once: they outlive the tests of the other kind, and no test stops them."""
    with ExitStack() as stack:

        @cache
        def swarm_of(kind: type[JsIpfs | Kubo]) -> Swarm:
            with ThreadPoolExecutor(2) as starting:
                a, b = starting.map(lambda daemon: stack.enter_context(daemon), (kind(), kind()))
            return Swarm(a, b)

        yield swarm_of


@pytest.fixture
def js_ipfs(swarms: Callable[[type[JsIpfs | Kubo]], Swarm]) -> JsIpfs:
    """A js-ipfs daemon, which no test stops; tests use topics of their own."""
    daemon = swarms(JsIpfs).a
    assert isinstance(daemon, JsIpfs)
    return daemon


@pytest.fixture
def shared_swarm(kind: type[JsIpfs | Kubo], swarms: Callable[[type[JsIpfs | Kubo]], Swarm]) -> Swarm:
    """Two daemons, which no test stops."""
    return swarms(kind)


@pytest.fixture
async def swarm(shared_swarm: Swarm) -> Swarm:
    """The two daemons, connected."""
    await shared_swarm.join()
    return shared_swarm


@pytest.fixture(scope="package")
def library() -> Iterator[LibraryNode]:
    """A Kubo library node without connections."""
    with LibraryNode() as node:
        yield node


@pytest.fixture
def topic() -> str:
    """The name of a lighthouse that no other test uses."""
    return f"market{next(_topics)}.lighthouse.3.robonomics.eth"


@pytest.fixture
async def bob(swarm: Swarm) -> AsyncIterator[LegacyClient]:
    """A legacy client of daemon B."""
    async with LegacyClient(swarm.b.api, pause=0.02 if isinstance(swarm.b, Kubo) else 0.002) as client:
        yield client
