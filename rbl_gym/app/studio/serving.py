"""The server of the studio's page: viser, on loopback unless told otherwise."""

from __future__ import annotations

import contextlib
import functools
import io
import re
import socket
from collections.abc import Iterator
from typing import Any

from rbl_gym.app.studio.scene_view import PANEL
from rbl_gym.checks import check_count
from rbl_gym.studies.extras import require

# Ports that are tried from the first on.
_PORTS = 50
BRAND = (24, 100, 171)
# Origins of pages that this machine serves, by whatever port.
_LOOPBACK = re.compile(r"https?://(127\.0\.0\.1|localhost|\[::1\])(:\d+)?")


def open_server(host: str = "127.0.0.1", port: int = 8080, title: str = "rbl-gym studio") -> Any:
    """A viser server with the studio's looks.

    Parameters
    ----------
    host
        Address on which it listens. Other machines can open the page where it is not loopback.
    port
        The first that is free from here on; 0: any.
    title
        Of the panel.

    Raises
    ------
    MissingExtraError
        Without viser (extra ``studio``).
    ValueError
        Where the address is none of this machine, or no port is free.
    """
    require("viser", "studio")
    import viser

    port = _free_port(host, check_count("port", port, least=0, most=65535))
    # It would print a frame of its own.
    with contextlib.redirect_stdout(io.StringIO()), _own_pages_only(host):
        server: Any = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    # A browser could ask for a tunnel to the outside.
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
    """On loopback, a server that is made here speaks to pages of this machine alone.

    Any page that is open in a browser may connect to loopback; the browser says whose it is.
    """
    from websockets.asyncio import server

    serve = server.serve
    if host in ("127.0.0.1", "localhost", "::1"):
        server.serve = functools.partial(serve, origins=[_LOOPBACK, None])  # type: ignore
    try:
        yield
    finally:
        server.serve = serve


def stop_server(server: Any) -> None:
    """End a server quietly."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _free_port(host: str, first: int) -> int:
    for port in range(first, min(first + (_PORTS if first else 1), 65536)):
        try:
            family, kind, number, _, address = socket.getaddrinfo(
                host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
            )[0]
        except OSError as error:
            raise ValueError(f"host must be an address of this machine, got {host!r}") from error
        with socket.socket(family, kind, number) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(address)
            except OSError:
                continue
            return probe.getsockname()[1]
    raise ValueError(f"no port is free on {host!r} from {first} on")
