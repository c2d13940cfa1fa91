"""`show` opens a problem, scene, environment or recording on a page of the studio."""

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
    """Options of serving a page.

    Attributes
    ----------
    host, port
        Address, by default loopback, and the first port to try; 0 selects any free port.
    folder
        Folder for all files.
    seed
        Seed of all searches.
    browser
        Whether to open a browser on the page.
    report
        Writes a report of a problem and a layout (M, 3) to a path; None: no report.
    """

    host: str = "127.0.0.1"
    port: int = 8080
    folder: str | Path = "."
    seed: int = 0
    browser: bool = True
    report: files.Report | None = None


class Studio:
    """A running page.

    Parameters
    ----------
    server
        The viser server.
    page
        The page that it serves.
    """

    def __init__(self, server: Any, page: Any) -> None:
        self.server, self.page = server, page

    @property
    def url(self) -> str:
        """The address of the page."""
        host = self.server.get_host()
        host = "127.0.0.1" if host in ("0.0.0.0", "::") else host
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server.get_port()}"

    def _repr_html_(self) -> str:
        """Return the page as a frame of a notebook."""
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
        """Save the layout and stop the server."""
        self.page.stop()
        serving.stop_server(self.server)


def show(
    what: Any,
    beside: Any = None,
    *,
    tables: Mapping[str, Any] | None = None,
    options: Options | None = None,
) -> Studio:
    """Open the studio and return at once.

    Parameters
    ----------
    what
        A `Problem` of `placement.scene_files`, to place its anchors by hand. Or an object to watch:
        a `Scene` (an episode), an environment, raw or wrapped, a `Recording` with its track, or a
        `rbl_gym.studies.watching.program.Program`.
    beside
        For a problem, anchors (M, 3) in metres; None: its own, or a usual layout. For a recording,
        its `Track` or a mapping of tracks by labels; None: the track of the filter ``"iekf-log"``.
        For a scene or environment, labels of filters; None: ``"iekf"`` and ``"iekf/robust=true"``,
        or the environment's own.
    tables
        Tables of the file from which the problem was read, for saving; None: derived from the
        problem.
    options
        Options of serving; None: on loopback, in a browser.

    Raises
    ------
    ValueError
        If `what` cannot be shown.
    MissingExtraError
        If viser is missing (extra ``studio``).
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
    """Return a function that makes the page of a problem; None if `what` is not a problem."""
    if not isinstance(what, Problem):
        return None
    start = open_state(what, layout)
    tables = files.tables_of(what) if tables is None else tables
    folder = Path(options.folder).resolve()
    return lambda server: PlacePage(server, start, tables, folder, options.report, options.seed)
