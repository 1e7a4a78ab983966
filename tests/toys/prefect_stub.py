"""An HTTP server in the place of Prefect's: it keeps what it is sent, or behaves badly."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from tests.toys.postgres import free_port


class Stub:
    """`got`: path and value of each request; `answer` gives the status and the text to a request."""

    def __init__(self, answer: Callable[[str], tuple[int, str]] | None = None) -> None:
        self.port, self.got = free_port(), list[tuple[str, Any]]()
        self._answer = answer or (lambda path: (200, json.dumps({"id": f"id{len(self.got)}"})))
        self._server: ThreadingHTTPServer | None = None

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/api"

    def start(self) -> None:
        stub = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                value = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                stub.got.append((self.path.removeprefix("/api"), value))
                status, text = stub._answer(self.path)
                self.send_response(status)
                self.send_header("Content-Length", str(len(text)))
                self.end_headers()
                self.wfile.write(text.encode())

            def do_GET(self) -> None:
                """No protection against forged requests, which the client asks for."""
                self.send_response(404)
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, *given: Any) -> None:
                pass

        class Server(ThreadingHTTPServer):
            def handle_error(self, *given: Any) -> None:
                """A client that has gone is no line."""

        self._server = Server(("127.0.0.1", self.port), Handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True).start()

    def stop(self) -> None:
        """As the end of its process: nothing listens any more."""
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
            self._server = None

    def states(self, runs: str) -> list[str]:
        """Types of the states that were set on `flow_runs` or `task_runs`, in their order."""
        found = [value.get("state", {}).get("type") for path, value in list(self.got) if path.startswith(f"/{runs}/")]
        return [s for s in found if s]


@contextmanager
def running(answer: Callable[[str], tuple[int, str]] | None = None) -> Iterator[Stub]:
    stub = Stub(answer)
    stub.start()
    try:
        yield stub
    finally:
        stub.stop()
