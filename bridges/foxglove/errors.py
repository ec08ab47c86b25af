"""The errors of `aira foxglove`."""

from __future__ import annotations

from mesh.errors import InputError


class ClientRefused(InputError, code="client-refused"):
    """A client of Foxglove may not connect, or sends too much. `status` is that of HTTP."""

    def __init__(self, status: str, why: str) -> None:
        super().__init__(why)
        self.status = status

    def response(self) -> bytes:
        """The HTTP response."""
        body = f"{self}\n".encode()
        head = f"HTTP/1.1 {self.status}\r\nContent-Type: text/plain; charset=utf-8\r\nContent-Length: {len(body)}\r\n"
        return head.encode() + b"Connection: close\r\nX-Content-Type-Options: nosniff\r\n\r\n" + body
