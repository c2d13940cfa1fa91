"""The server of the studio's page: viser, by default on loopback."""

from __future__ import annotations

import contextlib
import errno
import functools
import io
import re
import socket
from collections.abc import Iterator
from typing import Any

from rbl_gym.app.studio.scene_view import PANEL
from rbl_gym.checks import check_count
from rbl_gym.extras import require

# Number of ports to try, from the first on.
_PORTS = 50
BRAND = (24, 100, 171)
# Origins of pages that this machine serves, on any port.
_LOOPBACK = re.compile(r"https?://(127\.0\.0\.1|localhost|\[::1\])(:\d+)?")
_FOREIGN = "host must be an address of this machine, got {!r}"


def open_server(host: str = "127.0.0.1", port: int = 8080) -> Any:
    """Open a viser server with the theme of the studio.

    Other machines can open the page unless the address `host` is loopback. The first free port from
    `port` on is used; 0 selects any. Raises MissingExtraError without viser (extra ``studio``),
    ValueError if the address does not belong to this machine or no port is free.
    """
    require("viser", "studio", "the studio")
    import viser

    port = _free_port(host, check_count("port", port, least=0, most=65535))
    # viser would print a frame of its own.
    with contextlib.redirect_stdout(io.StringIO()), _own_pages_only(host):
        server: Any = viser.ViserServer(host=host, port=port, label="rbl-gym studio", verbose=False)
    # A browser could request a tunnel to the internet.
    server.request_share_url = lambda *_, **__: None
    server.gui.configure_theme(
        control_width="medium", show_logo=False, show_share_button=False, brand_color=BRAND
    )
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(PANEL)
    server.scene.set_up_direction("+z")
    server.scene.configure_environment_map(None)
    return server


@contextlib.contextmanager
def _own_pages_only(host: str) -> Iterator[None]:
    """Let servers on loopback, made in this context, accept pages of this machine only.

    Any page that is open in a browser may connect to loopback. The browser sends the page's origin.
    """
    from websockets.asyncio import server

    serve = server.serve
    if host in ("127.0.0.1", "localhost", "::1"):
        server.serve = functools.partial(serve, origins=[_LOOPBACK, None])  # pyrefly: ignore[bad-assignment]
    try:
        yield
    finally:
        server.serve = serve


def stop_server(server: Any) -> None:
    """Stop a server without messages."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _free_port(host: str, first: int) -> int:
    for port in range(first, min(first + (_PORTS if first else 1), 65536)):
        try:
            family, kind, number, _, address = socket.getaddrinfo(
                host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
            )[0]
        except OSError as error:
            raise ValueError(_FOREIGN.format(host)) from error
        with socket.socket(family, kind, number) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(address)
            except OSError as error:
                if error.errno == errno.EADDRNOTAVAIL:
                    raise ValueError(_FOREIGN.format(host)) from error
                continue
            return probe.getsockname()[1]
    raise ValueError(f"no port is free on {host!r} from {first}: choose another by --port")
