"""Serves a page on this computer, and streams to it what happens.

The server runs in threads of its own. What it is given is queued, and dropped where nobody takes it in time:
a browser that hangs, leaves or never comes changes nothing for whoever sends.
"""

from __future__ import annotations

import json
import math
import re
import socket
from collections.abc import Callable, Mapping
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_address
from threading import Thread
from time import monotonic
from typing import Any
from urllib.parse import parse_qsl

from amhe_cli.core.errors import AmheError, ConfigError
from amhe_cli.core.files import plain

#: Where only this computer reaches the page.
LOOPBACK = "127.0.0.1"
#: Time after which a browser that takes nothing, or has not asked for anything, is given up [s].
_PATIENCE = 5.0
#: Connections at a time, a thread each.
_MOST = 200


class _Handler(BaseHTTPRequestHandler):
    """Answers one browser; a server makes a class of it with what it serves."""

    timeout = _PATIENCE
    serves: PageServer
    asking: dict[socket.socket, float]  # connections without a request yet -> when they are given up

    def do_GET(self) -> None:
        self.asking[self.connection] = math.inf
        serves, (path, _, query) = self.serves, self.path.partition("?")
        if not serves.is_ours(self.headers.get("Host", "")):  # another site's name that leads here
            return self.send_error(403)
        if path == serves.path:
            page = serves.page() if callable(serves.page) else serves.page
            return self._send(serves.kind, page.encode())
        if path == "/stream" and serves.stream is not None:
            self._send("text/event-stream", None)
            return serves.stream(self._event)
        if path == "/ask" and serves.answer is not None:
            try:
                answer = serves.answer(dict(parse_qsl(query)))
            except AmheError as error:
                return self.send_error(400, str(error))
            return self._send("application/json", json.dumps(plain(answer)).encode())
        self.send_error(404)

    def end_headers(self) -> None:
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("X-Frame-Options", "DENY")
        super().end_headers()

    def _send(self, kind: str, whole: bytes | None) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        if whole is not None:
            self.send_header("Content-Length", str(len(whole)))
        self.end_headers()
        if whole is not None:
            self.wfile.write(whole)

    def _event(self, text: bytes) -> None:
        self.wfile.write(b"data: " + text + b"\n\n")

    def log_message(self, format: str, *args: Any) -> None: ...


class _Server(ThreadingHTTPServer):
    daemon_threads, block_on_close = True, False
    asking: dict[socket.socket, float]

    def handle_error(self, request: object, client_address: object) -> None:
        """A browser that leaves is no error."""

    def verify_request(self, request: Any, client_address: object) -> bool:
        self.asking[request] = monotonic() + _PATIENCE
        return len(self.asking) <= _MOST

    def shutdown_request(self, request: Any) -> None:
        self.asking.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        for request, end in list(self.asking.items()):  # one that sends a byte a second has no silence
            if end < monotonic():
                with suppress(OSError):
                    request.shutdown(socket.SHUT_RDWR)


class PageServer:
    """A page at an address; use it as a context manager.

    Args:
        page: The page, or a function that makes it at each request.
        host: Address to listen on.
        port: Port to listen on; 0: any that is free.
        stream: Sends what happens to one browser, through the function that it is given, until it returns;
            None: nothing happens.
        answer: Answers, as plain values, what the page asks at `ask?name=value`; None: it asks nothing.
        path: Path of the page at the address.
        kind: Its media type.

    Raises:
        ConfigError: The address cannot be listened on.
    """

    def __init__(
        self,
        page: str | Callable[[], str],
        host: str = LOOPBACK,
        port: int = 0,
        stream: Callable[[Callable[[bytes], None]], None] | None = None,
        answer: Callable[[Mapping[str, str]], Mapping[str, Any]] | None = None,
        path: str = "/",
        kind: str = "text/html; charset=utf-8",
    ) -> None:
        self.page, self.stream, self.answer, self.path, self.kind = page, stream, answer, path, kind
        self._host = host
        shared: dict[str, Any] = {"asking": {}}
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        server = type("Server", (_Server,), {"address_family": family, **shared})
        try:
            self._server = server((host, port), type("Handler", (_Handler,), {"serves": self, **shared}))
        except OSError as error:
            raise ConfigError(
                f"cannot listen on {host}:{port} ({error.strerror or error}); choose another `port` or `host`"
            ) from None
        self._thread = Thread(target=self._server.serve_forever, args=(0.2,), daemon=True)

    def is_ours(self, named: str) -> bool:
        """Whether the name that a browser was given is one of this computer, where only it is served."""
        address = str(self._server.server_address[0])
        name = re.sub(r":\d*$", "", named).removeprefix("[").removesuffix("]")  # no port where it is 80
        return not self.private or name.lower() in (address, self._host.lower(), "localhost")

    @property
    def address(self) -> str:
        """Where a browser finds the page."""
        host, port = self._server.server_address[:2]
        return f"http://{f'[{host}]' if ':' in str(host) else host}:{port}/"

    @property
    def private(self) -> bool:
        """Whether only this computer reaches it."""
        return ip_address(str(self._server.server_address[0])).is_loopback

    def __enter__(self) -> PageServer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
