"""The work of a session is kept: saved where that is asked for, and every change in an autosave."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rbl_gym.app.studio import files
from rbl_gym.app.studio.state import Layout, State
from rbl_gym.app.studio.world import Knobs

# Time between autosaves of a layout that goes on changing, seconds.
_APART_S = 1.0


class Keeper:
    """Writes the layout of a session into a folder.

    Parameters
    ----------
    start
        What is shown first.
    tables
        Of the file from which the problem was read.
    folder
        In which files are written, and only there.

    Attributes
    ----------
    found
        Anchors (M, 3) of the last session, metres, where they are not saved; or None.
    """

    def __init__(self, start: State, tables: Mapping[str, Any], folder: Path) -> None:
        self._tables, self._folder = tables, folder
        self._kept: tuple[Layout, Knobs] = start.layout, start.world.knobs
        self._time = -float("inf")
        self.found = files.last_session(start, folder)

    def keep(self, now: State) -> None:
        """Write the autosave, unless this layout and these knobs were written last."""
        layout, knobs = self._kept
        is_kept = now.layout is layout and now.world.knobs == knobs
        if (now.past or now.future) and not is_kept:
            self._time = time.monotonic()
            files.autosave(now, self._tables, self._folder)
            self._kept = now.layout, now.world.knobs

    def keep_meanwhile(self, now: State) -> None:
        """`keep`, at most once a second; where it fails, `keep` at the end will tell."""
        if time.monotonic() - self._time >= _APART_S:
            with contextlib.suppress(OSError, ValueError):
                self.keep(now)

    def save(self, now: State, name: str) -> list[Path]:
        """`files.save`."""
        paths = files.save(now, self._tables, self._folder, name)
        self._kept = now.layout, now.world.knobs
        return paths

    def save_report(self, now: State, name: str, report: files.Report) -> list[Path]:
        """`files.save_report`; from any thread."""
        return files.save_report(now, self._tables, self._folder, name, report)
