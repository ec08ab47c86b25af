"""Liveliness tokens: which are there now (`present_keys`), and which appear and go (`PresenceWatch`).

Zenoh 1.10 loses replies to a question for tokens that the session subscribes to, or once did: the session answers for
those itself, and the end of the router's replies may overtake its answer. So sessions keep what their subscribers were
told, and such a question returns that, too. A subscriber lives as long as its session.
"""

from __future__ import annotations

import threading
from itertools import islice
from typing import TYPE_CHECKING, Final

import zenoh

if TYPE_CHECKING:
    from collections.abc import Callable

    from mesh.base.flood import Drops

    Changed = Callable[[str, bool], object]

PRESENT_LIMIT: Final = 1024
"""Tokens that a question for those of now returns, at most."""
KEPT: Final = 4096
"""Tokens that a subscriber remembers, at most: strangers may declare any number."""


class _Tokens:
    """The tokens on a selector that a session has been told of."""

    def __init__(self, session: zenoh.Session, selector: str) -> None:
        self.session = session
        self.selector: Final = zenoh.KeyExpr(selector)
        self.keys = set[str]()
        self._has_overflowed = False
        """Whether there were tokens that are not remembered."""
        self.listeners: list[Changed] = []
        self.lock: Final = threading.RLock()
        # Directly, so that what the router says is known here before what it says next.
        receive = zenoh.handlers.Callback(self._receive, indirect=False)
        self._subscriber = session.liveliness().declare_subscriber(selector, receive, history=True)

    def _receive(self, sample: zenoh.Sample) -> None:
        key, is_present = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
        with self.lock:
            is_known = key in self.keys
            if is_known if is_present else not (is_known or self._has_overflowed):
                return
            if not is_present:
                self.keys.discard(key)
            elif len(self.keys) < KEPT:
                self.keys.add(key)
            else:
                self._has_overflowed = True
            for changed in tuple(self.listeners):
                changed(key, is_present)


_followed: Final = dict[tuple[str, str], _Tokens]()
"""By the Zenoh id of the session, and the selector."""
_lock: Final = threading.Lock()


class PresenceWatch:
    """Calls `changed` with the key of each token on a selector and True, and with False when it goes, until `end`.

    It is called on Zenoh's threads, and must not wait.
    """

    def __init__(self, session: zenoh.Session, selector: str, changed: Changed) -> None:
        self._changed = changed
        with _lock:
            for place in [place for place, tokens in _followed.items() if tokens.session.is_closed()]:
                del _followed[place]
            place = str(session.zid()), selector
            if place not in _followed:
                _followed[place] = _Tokens(session, selector)
            self._tokens = _followed[place]
        with self._tokens.lock:
            for key in self._tokens.keys:
                changed(key, True)
            self._tokens.listeners.append(changed)

    def end(self) -> None:
        """Call nobody any more."""
        with self._tokens.lock:
            self._tokens.listeners.remove(self._changed)


def present_keys(session: zenoh.Session, selector: str, *, timeout: float, drops: Drops | None = None) -> list[str]:
    """The keys of the tokens on a selector now, in order: at most `PRESENT_LIMIT`, more are counted in `drops`.

    Waits for the router, at most `timeout` seconds.
    """
    handler: zenoh.handlers.FifoChannel[zenoh.Reply] = zenoh.handlers.FifoChannel(PRESENT_LIMIT)
    replies = iter(session.liveliness().get(selector, handler, timeout=timeout))
    found = {str(reply.ok.key_expr) for reply in islice(replies, PRESENT_LIMIT) if reply.ok is not None}
    if (more := sum(1 for _ in replies)) and drops is not None:
        drops.count("presence", number=more)
    expression, zid = zenoh.KeyExpr(selector), str(session.zid())
    with _lock:
        followed = [tokens for (owner, _), tokens in _followed.items() if owner == zid]
    for tokens in followed:
        if tokens.selector.intersects(expression):
            with tokens.lock:
                found.update(key for key in tokens.keys if expression.intersects(zenoh.KeyExpr(key)))
    return sorted(found)[:PRESENT_LIMIT]
