"""The log of an edge agent, for whoever asks: it has no services of its own, so it answers on a topic of its device."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import msgspec

from bridges.serial.device_id import LOG
from mesh.errors import AiraError
from mesh.telemetry.logs import LogService
from schemas.logs import ReadLogs

if TYPE_CHECKING:
    from collections.abc import Iterator

    import zenoh

    from bridges.serial.device_id import DeviceId


@contextmanager
def tell_log(session: zenoh.Session, device: DeviceId) -> Iterator[None]:
    """Meanwhile answer with the last events of this process."""
    key, service = device.key(LOG), LogService("edge", "")

    def asked(query: zenoh.Query) -> None:
        """On a thread of Zenoh's: what is answered is in memory."""
        with query:
            try:
                payload = b"{}" if query.payload is None else query.payload.to_bytes()
                reply = service.read(ReadLogs.decode(payload)).encode()
            except AiraError as error:
                query.reply_err(msgspec.json.encode({"error": str(error), "hint": error.hint}))
            else:
                query.reply(key, reply, encoding="application/json")

    queryable: Any = session.declare_queryable(key, asked)
    try:
        yield
    finally:
        if not session.is_closed():
            queryable.undeclare()
