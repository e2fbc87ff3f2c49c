"""Who may talk to the server: pages that it has served itself, addressed as this machine."""

from __future__ import annotations

from urllib.parse import urlsplit

from tornado.web import HTTPError, RequestHandler

HOSTS = ("localhost", "127.0.0.1", "[::1]")
"""Names of this machine. Others may be anybody's that lead here (DNS rebinding)."""


class Guarded(RequestHandler):
    """A handler that refuses foreign hosts and origins before anything is read, and lets no page frame this one.

    `ancestors` of the application's settings are the origins whose pages may frame it: those of a notebook.
    """

    def set_default_headers(self) -> None:
        """What browsers enforce: no scripts, styles, images or connections but those of this server."""
        port = self.application.settings["port"]
        ancestors = self.application.settings["ancestors"]
        sockets = " ".join(f"ws://{host}:{port}" for host in HOSTS[:2])
        policy = {
            "default-src": "'none'", "script-src": "'self'", "style-src": "'self'", "img-src": "'self' blob:",
            "connect-src": f"'self' {sockets}", "base-uri": "'none'", "form-action": "'none'",
            "frame-ancestors": " ".join(ancestors) or "'none'",
        }  # fmt: skip
        self.set_header("Content-Security-Policy", "; ".join(f"{name} {value}" for name, value in policy.items()))
        if not ancestors:
            self.set_header("X-Frame-Options", "DENY")
        self.set_header("X-Content-Type-Options", "nosniff")
        self.set_header("Referrer-Policy", "no-referrer")  # the name of a work stands in the address
        self.set_header("Cross-Origin-Resource-Policy", "same-origin")
        self.set_header("Cache-Control", "no-store")
        self.clear_header("Server")

    def prepare(self) -> None:
        """403 for a Host header that is not this machine's, and for an Origin that is not this server's."""
        port = self.application.settings["port"]
        hosts = {f"{host}:{port}" for host in HOSTS}
        if self.request.headers.get_list("Host") not in [[host] for host in hosts]:
            raise HTTPError(403, reason="Foreign host")
        origin = self.request.headers.get("Origin")
        if origin is None:
            if self.request.method not in ("GET", "HEAD") or self._is_upgrade():
                raise HTTPError(403, reason="No origin")
        elif not self.is_own(origin):
            raise HTTPError(403, reason="Foreign origin")

    def is_own(self, origin: str) -> bool:
        """Whether a page is one of this server's."""
        parts = urlsplit(origin)
        port = self.application.settings["port"]
        return parts.scheme == "http" and parts.netloc in {f"{host}:{port}" for host in HOSTS}

    def _is_upgrade(self) -> bool:
        return self.request.headers.get("Upgrade", "").lower() == "websocket"

    def write_error(self, status_code: int, **values: object) -> None:
        """The reason in a line, never a traceback."""
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(f"{status_code} {self._reason}\n")


class Nothing(Guarded):
    """Whatever else is asked for."""

    def prepare(self) -> None:
        """404, once host and origin are right."""
        super().prepare()
        raise HTTPError(404)
