"""Saving of a session: on request, and every change in an autosave."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rbl_gym.app.studio import files
from rbl_gym.app.studio.state import Layout, State
from rbl_gym.app.studio.world import Knobs

# Minimum time between two autosaves, seconds.
_APART_S = 1.0


class Keeper:
    """Writes the layout of a session into a folder.

    `found` are unsaved anchors (M, 3) of the last session, metres, or None.
    """

    def __init__(self, start: State, tables: Mapping[str, Any], folder: Path) -> None:
        self._tables, self._folder = tables, folder
        self._kept: tuple[Layout, Knobs] = start.layout, start.world.knobs
        self._time = -float("inf")
        self.found = files.last_session(start, folder)

    def keep(self, now: State) -> None:
        """Write the autosave, unless it has this layout and these knobs already."""
        layout, knobs = self._kept
        is_kept = now.layout is layout and now.world.knobs == knobs
        if (now.past or now.future) and not is_kept:
            self._time = time.monotonic()
            files.autosave(now, self._tables, self._folder)
            self._kept = now.layout, now.world.knobs

    def keep_meanwhile(self, now: State) -> None:
        """Run `keep` at most once a second. Errors are left to `keep` at the end."""
        if time.monotonic() - self._time >= _APART_S:
            with contextlib.suppress(OSError, ValueError):
                self.keep(now)

    def save(self, now: State, name: str) -> list[Path]:
        """Run `files.save`."""
        paths = files.save(now, self._tables, self._folder, name)
        self._kept = now.layout, now.world.knobs
        return paths

    def save_report(self, now: State, name: str, report: files.Report) -> list[Path]:
        """Run `files.save_report`; any thread may call it."""
        return files.save_report(now, self._tables, self._folder, name, report)
