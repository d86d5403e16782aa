"""The playground on loopback: only GET, only files of the site, only for pages of this server."""

from __future__ import annotations

from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

from powderdsl.diagnostics import CompileError
from powderdsl.web.site import Site

ADDRESS = "127.0.0.1"
TYPES = {
    "css": "text/css; charset=utf-8",
    "html": "text/html; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "json": "application/json",
    "mjs": "text/javascript; charset=utf-8",
    "png": "image/png",
    "svg": "image/svg+xml",
    "wasm": "application/wasm",
    "zip": "application/zip",
}


class SiteServer(ThreadingHTTPServer):
    """Serves one site. A file that takes long to make does not hold others up."""

    daemon_threads = True

    def __init__(self, site: Site, port: int = 0):
        super().__init__((ADDRESS, port), _Handler)
        self.site = site

    @property
    def address(self) -> str:
        return f"http://{ADDRESS}:{self.server_port}/"


class _Handler(BaseHTTPRequestHandler):
    server: SiteServer
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        own = {f"{name}:{self.server.server_port}" for name in (ADDRESS, "localhost")}
        origin = self.headers.get("Origin")
        # A page elsewhere can neither name this server (Host) nor read it from its own origin (Origin).
        if self.headers.get("Host") not in own or (origin and origin not in {f"http://{one}" for one in own}):
            self._answer(HTTPStatus.FORBIDDEN, b"this server answers its own page only", "txt")
            return
        path = unquote(urlsplit(self.path).path).lstrip("/") or "index.html"
        try:
            data = self.server.site.read(path)
        except CompileError as error:
            self._answer(HTTPStatus.INTERNAL_SERVER_ERROR, str(error).encode(), "txt")
            return
        if data is None:
            self._answer(HTTPStatus.NOT_FOUND, b"no such file", "txt")
        else:
            self._answer(HTTPStatus.OK, data, path.rpartition(".")[2])

    def _answer(self, status: HTTPStatus, data: bytes, suffix: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", TYPES.get(suffix, "text/plain; charset=utf-8"))
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Cache-Control", "no-cache")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        try:
            self.wfile.write(data)
        except (BrokenPipeError, ConnectionResetError):
            self.close_connection = True

    def log_message(self, *_: object) -> None:
        pass
