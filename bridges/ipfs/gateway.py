"""A read-only gateway: content by HTTP, as public nodes give it to everybody."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Self

import aiohttp

from bridges.ipfs.addresses import base_url, without_credentials
from bridges.ipfs.errors import DaemonRefused, DaemonUnreachable
from mesh.errors import ClosedError

if TYPE_CHECKING:
    from types import TracebackType

RAW: Final = "application/vnd.ipld.raw"
"""The media type of a bare block: the one thing of a gateway that can be checked."""


class Gateway:
    """The gateway at `address` (a multiaddr or a URL): `async with Gateway(address) as gateway`.

    Raises `DaemonUnreachable` and `DaemonRefused` as a `Daemon` does.
    """

    def __init__(self, address: str) -> None:
        self._base = base_url(address)
        self.api: Final = without_credentials(self._base)
        self._http: aiohttp.ClientSession | None = None

    async def __aenter__(self) -> Self:
        self._http = aiohttp.ClientSession()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        http, self._http = self._http, None
        if http is not None:
            await http.close()

    async def block(self, cid: str, *, limit: int, timeout: float) -> bytes:
        """A block by its name, unchecked. Raises `DaemonRefused` also for more than `limit` bytes.

        `timeout` is in seconds. Gateways older than 2022 give whole files only, and are of no use here.
        """
        if self._http is None:
            raise ClosedError("the client of the IPFS gateway is not open", hint="use it inside `async with`")
        try:
            async with self._http.get(
                f"{self._base}/ipfs/{cid}",
                params={"format": "raw"},
                headers={"Accept": RAW},
                timeout=aiohttp.ClientTimeout(total=timeout),
            ) as answer:
                if answer.status != 200:
                    raise DaemonRefused(self.api, answer.status, f"HTTP {answer.status} for {cid}")
                if answer.content_type != RAW:
                    raise DaemonRefused(self.api, answer.status, "this gateway gives no blocks, only whole files")
                content = bytearray()
                async for chunk in answer.content.iter_any():
                    content += chunk
                    if len(content) > limit:
                        raise DaemonRefused(self.api, answer.status, f"an answer of more than {limit} bytes")
        except (aiohttp.ClientError, TimeoutError) as error:
            raise DaemonUnreachable(self.api, str(error) or type(error).__name__) from error
        return bytes(content)
