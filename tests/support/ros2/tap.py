"""Hears all that a ROS 2 system sends, by Zenoh alone.

So nothing of the bridge is in what the bridge is compared with.
"""

from __future__ import annotations

import json
import struct
from typing import Any

import zenoh

from tests.support.ros2.peers import VECTORS
from tests.support.routers import client_config

REQUEST = bytes.fromhex("00010000" + "0200000000000000" + "0300000000000000")
"""AddTwoInts of 2 and 3."""
ATTACHMENT = struct.pack("<qqB16s", 7, 1_700_000_000_000_000_000, 16, bytes(range(16)))
SAMPLES_OF_A_KEY = 3


class Tap:
    """Hears the messages, requests and tokens of domain 0: of each key as many as `limit`."""

    def __init__(self, endpoint: str, *, limit: int = SAMPLES_OF_A_KEY) -> None:
        self._limit = limit
        self._session = zenoh.open(client_config(endpoint))
        self.heard: dict[str, list[dict[str, Any]]] = {"samples": [], "requests": [], "replies": []}
        self.tokens: set[str] = set()
        self._session.declare_subscriber("0/**", lambda sample: self._take("samples", sample))
        self._session.declare_queryable("0/**", self._query, complete=True)
        self._session.liveliness().declare_subscriber("@ros2_lv/**", self._token, history=True)

    def ask(self, key: str) -> None:
        """Send a request, and record the reply."""
        for reply in self._session.get(
            key, payload=REQUEST, attachment=ATTACHMENT, target=zenoh.QueryTarget.ALL, timeout=20.0
        ):
            if reply.ok is not None:
                self._take("replies", reply.ok)

    def key_of(self, part: str) -> str:
        """The key of the service whose token has `part` in it."""
        token = next(token for token in self.tokens if part in token and "/SS/" in token)
        name, kind, type_hash = token.split("/")[9:12]
        return f"0/{name.replace('%', '/').strip('/')}/{kind}/{type_hash}"

    def close(self) -> None:
        """Hear no more."""
        self._session.close()  # type: ignore[no-untyped-call]

    def write(self, name: str, origin: str) -> None:
        """Write what was heard."""
        vectors = {"origin": origin, **self.heard, "tokens": sorted(self.tokens)}
        (VECTORS / name).write_text(json.dumps(vectors, indent=1) + "\n")
        self.close()

    def _token(self, sample: zenoh.Sample) -> None:
        self.tokens.add(str(sample.key_expr))

    def _query(self, query: zenoh.Query) -> None:
        self._take("requests", query)
        query.drop()  # type: ignore[no-untyped-call]

    def _take(self, what: str, heard: Any) -> None:
        key = str(heard.key_expr)
        taken = self.heard[what]
        if sum(one["key"] == key for one in taken) < self._limit:
            payload, attachment = heard.payload, heard.attachment
            taken.append(
                {
                    "key": key,
                    "payload": payload.to_bytes().hex() if payload else "",
                    "attachment": attachment.to_bytes().hex() if attachment else "",
                }
            )
