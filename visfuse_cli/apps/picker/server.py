"""The page's server: this machine only, nothing without the token in the address, no path but those in its table."""

from __future__ import annotations

import json
import secrets
import sys
import threading
import traceback
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from types import TracebackType
from typing import Any
from urllib.parse import parse_qs, urlsplit

from visfuse_cli.apps.picker.desk import Desk
from visfuse_cli.errors import OutputError, VisfuseError

HOST = "127.0.0.1"
LARGEST = 1_000_000  # bytes that a request may carry
SILENCE_S = 30.0  # after which an idle connection is closed
PAGE = {
    "": ("page.html", "text/html; charset=utf-8"),
    "style.css": ("style.css", "text/css; charset=utf-8"),
    **{name: (name, "text/javascript; charset=utf-8") for name in ("main.js", "view.js", "sheet.js", "table.js")},
}
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class Server:
    """`with Server(desk, port) as server:` answers at `server.address` from threads of its own; port 0 is any free one.

    Raises OutputError where the port is taken.
    """

    def __init__(self, desk: Desk, port: int = 0) -> None:
        try:
            self._http = _Http(port, desk)
        except OSError as problem:
            raise OutputError(f"--port {port}: cannot be served on: {problem.strerror or problem}") from problem
        self.port = self._http.server_port
        self.address = f"http://{HOST}:{self.port}/{self._http.token}/"
        self._thread = threading.Thread(
            target=self._http.serve_forever, args=(0.05,), name="visfuse-picker", daemon=True
        )

    def __enter__(self) -> Server:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._http.shutdown()
        self._http.server_close()


class _Refusal(Exception):
    def __init__(self, status: HTTPStatus) -> None:
        super().__init__(status.phrase)
        self.status = status


class _Http(ThreadingHTTPServer):
    """A server that knows its desk, and the token without which it says nothing."""

    daemon_threads = True

    def __init__(self, port: int, desk: Desk) -> None:
        self.desk, self.token = desk, secrets.token_urlsafe(24)
        super().__init__((HOST, port), _Handler)


class _Handler(BaseHTTPRequestHandler):
    """One request."""

    server: _Http
    timeout = SILENCE_S
    server_version, sys_version = "visfuse", ""

    def do_GET(self) -> None:
        self._answer(self._get)

    def do_POST(self) -> None:
        self._answer(self._post)

    def _answer(self, work: Any) -> None:
        try:
            work(self._admitted())
        except _Refusal as refusal:
            self._send(refusal.status, str(refusal).encode(), "text/plain")
        except VisfuseError as problem:
            self._json({"reason": str(problem)}, HTTPStatus.UNPROCESSABLE_ENTITY)
        except (BrokenPipeError, ConnectionResetError):
            pass  # the page has gone
        except Exception as problem:  # a defect must not cost what was picked so far
            traceback.print_exc(file=sys.stderr)
            self._json({"reason": f"internal error: {problem}"}, HTTPStatus.INTERNAL_SERVER_ERROR)

    def _admitted(self) -> str:
        """What is asked for, after the token; everything foreign is refused before it is looked at."""
        port = self.server.server_port
        hosts = {f"{HOST}:{port}", f"localhost:{port}"}
        if self.headers.get("Host") not in hosts:
            raise _Refusal(HTTPStatus.FORBIDDEN)
        origin = self.headers.get("Origin")
        if origin is not None and origin not in {f"http://{host}" for host in hosts}:
            raise _Refusal(HTTPStatus.FORBIDDEN)
        key, separator, rest = urlsplit(self.path).path.removeprefix("/").partition("/")
        if not (separator and secrets.compare_digest(key.encode(), self.server.token.encode())):
            raise _Refusal(HTTPStatus.FORBIDDEN)
        return rest

    def _get(self, name: str) -> None:
        if name in PAGE:
            file, kind = PAGE[name]
            self._send(HTTPStatus.OK, (resources.files(__package__) / "page" / file).read_bytes(), kind)
        elif name == "about":
            self._json(self.server.desk.about())
        elif name == "frame":
            when, picture = self.server.desk.frame(self._time())
            self._send(HTTPStatus.OK, picture, "image/png", {"X-Time": f"{when!r}"})
        else:
            raise _Refusal(HTTPStatus.NOT_FOUND)

    def _post(self, name: str) -> None:
        work = {"fit": self.server.desk.fit, "snap": self.server.desk.snap, "save": self.server.desk.save}.get(name)
        if work is None:
            raise _Refusal(HTTPStatus.NOT_FOUND)
        self._json(work(self._body()))
        if name == "save":
            self.server.desk.done.set()  # after the answer, which is the last one

    def _time(self) -> float:
        try:
            return float(parse_qs(urlsplit(self.path).query)["t"][0])
        except (KeyError, ValueError):
            raise _Refusal(HTTPStatus.BAD_REQUEST) from None

    def _body(self) -> dict[str, Any]:
        if self.headers.get_content_type() != "application/json":  # no form of a foreign page sends that
            raise _Refusal(HTTPStatus.UNSUPPORTED_MEDIA_TYPE)
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > LARGEST:
            raise _Refusal(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        try:
            body = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            raise _Refusal(HTTPStatus.BAD_REQUEST) from None
        if not isinstance(body, dict):
            raise _Refusal(HTTPStatus.BAD_REQUEST)
        return body

    def _json(self, value: dict[str, Any], status: HTTPStatus = HTTPStatus.OK) -> None:
        self._send(status, json.dumps(value, allow_nan=False).encode(), "application/json")

    def _send(self, status: HTTPStatus, body: bytes, kind: str, more: dict[str, str] | None = None) -> None:
        self.send_response(status)
        for name, value in ({"Content-Type": kind, "Content-Length": str(len(body))} | HEADERS | (more or {})).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *args: Any) -> None:
        """Say nothing: the terminal is for results."""
