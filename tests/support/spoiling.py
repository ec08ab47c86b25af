"""A proxy in front of an Ethereum node that spoils some of its answers."""

from __future__ import annotations

import json
import random
from collections import Counter
from typing import TYPE_CHECKING, Any, Final, Self

from aiohttp import ClientSession, web

if TYPE_CHECKING:
    from collections.abc import Callable

WRONG: Final[tuple[Any, ...]] = (5, -1, 1.5, True, "hello", "0xzz", [], [None], {}, {"a": 1})
"""Values that no field of an answer may have where another of these is right."""


def null(response: dict[str, Any], chance: random.Random) -> bytes:
    """The answer with a null in place of a field."""
    _replace(response, chance, lambda _: None)
    return json.dumps(response).encode()


def missing(response: dict[str, Any], chance: random.Random) -> bytes:
    """The answer without one of its fields."""
    owner, name = _place(response, chance)
    while isinstance(owner, list):  # one log less is no missing field
        owner, name = _place(response, chance)
    del owner[name]
    return json.dumps(response).encode()


def mistyped(response: dict[str, Any], chance: random.Random) -> bytes:
    """The answer with a value of another type in place of a field."""
    _replace(response, chance, lambda old: chance.choice([new for new in WRONG if type(new) is not type(old)]))
    return json.dumps(response).encode()


def truncated(response: dict[str, Any], chance: random.Random) -> bytes:
    """The beginning of the answer."""
    body = json.dumps(response).encode()
    return body[: chance.randrange(1, len(body))]


def emptied(response: dict[str, Any], chance: random.Random) -> bytes:
    """What a node says of a contract that it does not have."""
    return json.dumps(response | {"result": "0x"} if "result" in response else response).encode()


KINDS: Final = {spoil.__name__: spoil for spoil in (null, missing, mistyped, truncated)}


class SpoilingProxy:
    """`async with SpoilingProxy(node, …) as proxy`: serves the node at the URL `node` under `proxy.url`.

    A share `rate` of the answers to each of `methods` (None: all) is spoiled, each in one of `kinds`. Which ones
    depends on the `seed`, the method and how often it was asked, so not on the timing between methods.
    """

    def __init__(
        self,
        node: str,
        *,
        seed: int,
        rate: float = 0.03,
        methods: frozenset[str] | None = None,
        kinds: tuple[str, ...] = tuple(KINDS),
    ) -> None:
        self.rate = rate
        self.asked: Counter[str] = Counter()
        self.spoiled: Counter[tuple[str, str]] = Counter()
        """Spoiled answers by method and kind."""
        self._node = node
        self._seed = seed
        self._methods = methods
        self._kinds = kinds
        app = web.Application(client_max_size=1 << 26)
        app.router.add_post("/", self._forward)
        self._runner = web.AppRunner(app, shutdown_timeout=0.1, access_log=None)

    async def __aenter__(self) -> Self:
        self._session = ClientSession()
        await self._runner.setup()
        await web.TCPSite(self._runner, "127.0.0.1", 0).start()
        self.url = f"http://127.0.0.1:{self._runner.addresses[0][1]}"
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self._runner.cleanup()
        await self._session.close()

    async def _forward(self, request: web.Request) -> web.Response:
        body = await request.read()
        method = json.loads(body)["method"]
        async with self._session.post(self._node, data=body, headers={"Content-Type": "application/json"}) as answer:
            response = await answer.read()
        self.asked[method] += 1
        chance = random.Random(f"{self._seed} {method} {self.asked[method]}")
        if (self._methods is None or method in self._methods) and chance.random() < self.rate:
            kind = chance.choice(self._kinds)
            self.spoiled[method, kind] += 1
            response = {**KINDS, "emptied": emptied}[kind](json.loads(response), chance)
        return web.Response(body=response, content_type="application/json")


def _place(response: dict[str, Any], chance: random.Random) -> tuple[Any, Any]:
    """A field of the answer: the result or error as a whole, one of its fields, or one of a log's."""
    owner: Any = response
    name: Any = "result" if "result" in response else "error"
    while chance.random() < 0.7:
        inner = owner[name]
        if isinstance(inner, list) and inner:
            owner, name = inner, chance.randrange(len(inner))
        elif isinstance(inner, dict) and inner:
            owner, name = inner, chance.choice(sorted(inner))
        else:
            break
    return owner, name


def _replace(response: dict[str, Any], chance: random.Random, new: Callable[[Any], Any]) -> None:
    owner, name = _place(response, chance)
    owner[name] = new(owner[name])
