"""`show`: what can be opened in the studio, and the page that it gets."""

from __future__ import annotations

import functools
import webbrowser
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from rbl_gym.app.studio import files, serving
from rbl_gym.app.studio.place import PlacePage
from rbl_gym.app.studio.state import open_state
from rbl_gym.app.studio.watch_page import WatchPage
from rbl_gym.checks import FloatArray, check_count
from rbl_gym.placement.building import Problem
from rbl_gym.studies.watching.program import program_of

__all__ = ["Options", "Studio", "show"]


class Options(NamedTuple):
    """How a page is served.

    Attributes
    ----------
    host, port
        Address, loopback unless it is said otherwise, and the first port that is tried; 0: any.
    folder
        In which files are written, and only there.
    seed
        Of all searches.
    browser
        Whether a browser is opened on the page.
    report
        Writes a report of a problem and a layout (M, 3) to a path; None: there is none.
    """

    host: str = "127.0.0.1"
    port: int = 8080
    folder: str | Path = "."
    seed: int = 0
    browser: bool = True
    report: files.Report | None = None


class Studio:
    """A page that is being served.

    Parameters
    ----------
    server
        The viser server.
    page
        What it shows.
    """

    def __init__(self, server: Any, page: Any) -> None:
        self.server, self.page = server, page

    @property
    def url(self) -> str:
        """Where the page is."""
        host = self.server.get_host()
        host = "127.0.0.1" if host in ("0.0.0.0", "::") else host
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server.get_port()}"

    def _repr_html_(self) -> str:
        """The page within a notebook."""
        return f'<iframe src="{self.url}" width="100%" height="650" frameborder="0"></iframe>'

    def wait(self) -> None:
        """Serve until interrupted (Ctrl-C), then stop."""
        try:
            self.server.sleep_forever()
        except KeyboardInterrupt:
            pass
        finally:
            self.stop()

    def stop(self) -> None:
        """Keep the layout, and end the server."""
        self.page.stop()
        serving.stop_server(self.server)


def show(
    what: Any,
    beside: Any = None,
    *,
    tables: Mapping[str, Any] | None = None,
    options: Options | None = None,
) -> Studio:
    """Open the studio on something, and return at once.

    Parameters
    ----------
    what
        A `Problem` of `placement.scene_files`: its anchors are placed by hand. Or what is watched:
        a `Scene` (an episode), an environment, raw or wrapped, a `Recording` with its track, a
        `rbl_gym.studies.watching.program.Program`.
    beside
        Of a problem, anchors (M, 3), metres; None: its own, or a usual layout. Of a recording, its
        `Track` or a mapping of tracks by labels; None: that of the filter ``"iekf-log"``. Of a
        scene or environment, labels of filters; None: ``"iekf"`` and ``"iekf-robust"``, or the
        environment's own.
    tables
        Of the file from which the problem was read, for saving; None: made of the problem.
    options
        How the page is served; None: on loopback, in a browser.

    Raises
    ------
    ValueError
        On what cannot be shown.
    MissingExtraError
        Without viser (extra ``studio``).
    """
    options = Options() if options is None else options
    check_count("seed", options.seed, least=0)
    make = _placing(what, beside, tables, options)
    if make is None:
        program = program_of(what, beside, options.seed)
        make = functools.partial(WatchPage, program=program)
    server = serving.open_server(options.host, options.port)
    try:
        page = make(server)
    except BaseException:
        serving.stop_server(server)
        raise
    studio = Studio(server, page)
    if options.browser:
        webbrowser.open(studio.url)
    return studio


def _placing(
    what: Any, layout: FloatArray | None, tables: Mapping[str, Any] | None, options: Options
) -> Callable[[Any], Any] | None:
    """Makes the page of a problem; None: it is none."""
    if not isinstance(what, Problem):
        return None
    start = open_state(what, layout)
    tables = files.tables_of(what) if tables is None else tables
    folder = Path(options.folder).resolve()
    return lambda server: PlacePage(server, start, tables, folder, options.report, options.seed)
