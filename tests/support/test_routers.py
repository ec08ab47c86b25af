from __future__ import annotations

import queue
from typing import TYPE_CHECKING

import pytest
import zenoh

from tests.support.routers import EmbeddedRouter, Zenohd, client_config

if TYPE_CHECKING:
    from collections.abc import Iterator

KEY = "aira/test/routed"


@pytest.fixture(params=["embedded", "zenohd"])
def any_router(request: pytest.FixtureRequest) -> Iterator[EmbeddedRouter | Zenohd]:
    running: EmbeddedRouter | Zenohd = EmbeddedRouter() if request.param == "embedded" else Zenohd()
    with running:
        yield running


def wait_until_matched(publisher: zenoh.Publisher) -> None:
    """Return when a subscriber of the publisher's key is known; a put before that may reach nobody."""
    changes: queue.SimpleQueue[bool] = queue.SimpleQueue()
    publisher.declare_matching_listener(lambda status: changes.put(status.matching))
    while not (is_matched(publisher) or changes.get(timeout=60)):
        pass


def is_matched(publisher: zenoh.Publisher) -> bool:
    # Zenoh's stub calls this a bool.
    matching: bool = publisher.matching_status.matching  # type: ignore[attr-defined]
    return matching


def routed(endpoint: str) -> bytes:
    """The message that a subscriber behind the router receives when another client publishes."""
    heard: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    with zenoh.open(client_config(endpoint)) as listener, zenoh.open(client_config(endpoint)) as speaker:
        listener.declare_subscriber(KEY, lambda sample: heard.put(sample.payload.to_bytes()))
        publisher = speaker.declare_publisher(KEY)
        wait_until_matched(publisher)
        publisher.put(b"over the router")
        return heard.get(timeout=60)


def test_a_router_carries_a_message_between_two_clients(any_router: EmbeddedRouter | Zenohd) -> None:
    assert routed(any_router.endpoint) == b"over the router"


def test_a_router_comes_back_on_the_same_endpoint(any_router: EmbeddedRouter | Zenohd) -> None:
    any_router.stop()
    with pytest.raises(zenoh.ZError):
        zenoh.open(client_config(any_router.endpoint))
    any_router.start()
    assert routed(any_router.endpoint) == b"over the router"


def test_zenohd_uses_the_configuration_of_a_test() -> None:
    rule = {
        "id": "secrets",
        "permission": "deny",
        "flows": ["ingress"],
        "messages": ["declare_subscriber"],
        "key_exprs": ["aira/secret"],
    }
    control = {
        "enabled": True,
        "default_permission": "allow",
        "rules": [rule],
        "subjects": [{"id": "everybody"}],
        "policies": [{"rules": ["secrets"], "subjects": ["everybody"]}],
    }
    with (
        Zenohd(config={"access_control": control}) as router,
        zenoh.open(client_config(router.endpoint)) as speaker,
        zenoh.open(client_config(router.endpoint)) as listener,
    ):
        secret, public = speaker.declare_publisher("aira/secret"), speaker.declare_publisher("aira/public")
        for key in ("aira/secret", "aira/public"):
            listener.declare_subscriber(key, lambda sample: None)
        wait_until_matched(public)
        assert not is_matched(secret)


async def test_routers_are_async_contexts_too() -> None:
    async with EmbeddedRouter() as router:
        assert routed(router.endpoint) == b"over the router"
