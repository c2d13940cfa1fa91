"""The page for watching filters: a player of frames, the same for every browser."""

from __future__ import annotations

import time
import traceback
from collections.abc import Iterator
from typing import Any

import numpy as np

from rbl_gym.app.studio import scene_view
from rbl_gym.app.studio.watch_panel import CHARTS_WIDTH, WatchPanel
from rbl_gym.app.studio.watch_view import WatchView
from rbl_gym.app.studio.worker import Worker, in_order
from rbl_gym.geometry.polygons import prism_edges
from rbl_gym.studies.watching.live import CALM, Disturbances
from rbl_gym.studies.watching.program import Program

# Pictures and charts per second at most; the longest wait between two checks for requests.
_PICTURES_HZ, _CHARTS_HZ, _WAIT_S = 20.0, 4.0, 0.05
# Frames for the paths, the charts and the averages.
_PAST = 300
# The floor is transparent, because estimates may lie below it.
_FLOOR = 0.5
# Position of a camera that follows the body, relative to it, in radii of the body.
_BEHIND = np.array([-2.5, -7.0, 5.0])


class WatchPage:
    """Shows the frames of a program in a viser server."""

    def __init__(self, server: Any, program: Program) -> None:
        self._server, self.program = server, program
        self._filters, self._seed = program.filters, program.seed
        self._disturbances = CALM
        self._speed, self._playing, self._over = 1.0, False, False
        self._links, self._follow = 0, False
        self.status = ""
        self._drawn, self._charted = 0.0, 0.0
        self._open()
        panels = scene_view.PANEL + (CHARTS_WIDTH if program.filters else 0)
        scene_view.set_camera(server, program.room, panels)
        if self.frames[0].picture is None:
            scene_view.draw_room(server, program.room, _FLOOR)
            for index, zone in enumerate(program.room.zones):
                edges = prism_edges(zone.polygon, zone.low_m, zone.high_m)
                scene_view.lines(server.scene, f"/zones/{index}", edges, scene_view.RACK, 1)
        extent = scene_view.extent_of(program.room)
        self._view = WatchView(server.scene, extent, program.tags)
        actions = {
            "play": self.play_or_pause,
            "step": self.step,
            "restart": self.restart,
            "speed": self.set_speed,
            "seek": self.seek,
            "begin": self.restart,
            "disturb": self.disturb,
            "links": self._set_links,
            "follow": self._set_follow,
        }
        self._panel = WatchPanel(server.gui, program, actions)
        self._worker = Worker(self._failed)
        self._worker.post(self._show)
        if self.frames[0].picture is not None:
            # The picture is fitted to the window.
            server.on_client_connect(lambda _: self._worker.post(self._show))

    # --- requests of the page ---------------------------------------------------------------

    @in_order()
    def play_or_pause(self) -> None:
        """Play from the current frame, or stop; at the end, start again."""
        if not self._playing and self._over and self.at == len(self.frames) - 1:
            self._open()
            self._view.clear()
        self._set_playing(not self._playing)

    @in_order()
    def step(self) -> None:
        """Stop, and show the next frame."""
        self._set_playing(False)
        self._advance()
        self._show()

    @in_order()
    def restart(self, filters: tuple[str, ...] | None = None, seed: int | None = None) -> None:
        """Go back to the first frame, with other filters or another seed if given.

        The disturbances remain, and a page that plays goes on playing.
        """
        before = self._filters, self._seed
        self._filters = self._filters if filters is None else filters
        self._seed = self._seed if seed is None else seed
        try:
            self._open()
        except Exception:
            self._filters, self._seed = before
            raise
        self._links = 0
        self.status = ""
        self._view.clear()
        self._panel.name_filters(self._filters)
        self._set_playing(self._playing)

    @in_order("seek")
    def seek(self, at: int) -> None:
        """Stop, and show a frame that was played before."""
        self._set_playing(False)
        self.at = min(max(at, 0), len(self.frames) - 1)
        self._show()

    @in_order()
    def set_speed(self, factor: float) -> None:
        """Set the speed relative to the clock; inf plays as fast as possible."""
        self._speed = factor
        if self._playing:
            self._set_playing(True)

    @in_order("disturb")
    def disturb(self, disturbances: Disturbances) -> None:
        """Disturb all frames that are not computed yet."""
        self._disturbances = disturbances
        self._panel.show_disturbances(disturbances)
        # Show the last computed frame: the next one has the new disturbances.
        if not self._over and self.at < len(self.frames) - 1:
            self.at = len(self.frames) - 1
            self._show()

    def settle(self, timeout: float = 60.0) -> bool:
        """Wait until all requests are shown; return whether this was within the time limit."""
        return self._worker.settle(timeout)

    def stop(self) -> None:
        """Stop the worker."""
        self._worker.stop()

    @in_order()
    def _set_links(self, which: int) -> None:
        self._links = which
        self._show()

    @in_order()
    def _set_follow(self, follow: bool) -> None:
        self._follow = follow
        if not follow:
            for client in self._server.get_clients().values():
                scene_view.look(client, self.program.room, 0)
        self._show()

    # --- tasks of the worker ----------------------------------------------------------------

    def _open(self) -> None:
        """Compute the first frame of a new episode; a ValueError leaves the page unchanged."""
        source = self.program.start(self._filters, self._seed, lambda epoch: self._disturbances)
        self.frames, self.at, self._source, self._over = [next(source)], 0, source, False

    def _set_playing(self, playing: bool) -> None:
        self._playing = playing
        self._worker.when_idle(self._play() if playing else None)
        self._show()

    def _advance(self) -> bool:
        """Go on by one frame; return False at the end."""
        if self.at == len(self.frames) - 1:
            found = next(self._source, None)
            if found is None:
                self._over, self.status = True, "The episode is over."
                return False
            self.frames.append(found)
        self.at += 1
        return True

    def _play(self) -> Iterator[None]:
        """Play frames by the clock. Each step is short, so that tasks can run in between."""
        start, first = time.perf_counter(), self.frames[self.at].time_s
        while self._advance():
            due = start + (self.frames[self.at].time_s - first) / self._speed
            while (wait := due - time.perf_counter()) > 0:
                time.sleep(min(wait, _WAIT_S))
                yield
            # Far behind the clock: restart the clock here.
            if wait < -1.0 and np.isfinite(self._speed):
                start, first = time.perf_counter(), self.frames[self.at].time_s
            self._show_if_due()
            yield
        self._playing = False
        self._show()

    def _show_if_due(self) -> None:
        now = time.perf_counter()
        if now - self._drawn >= 1 / _PICTURES_HZ:
            self._show(with_charts=now - self._charted > 1 / _CHARTS_HZ)

    def _show(self, with_charts: bool = True) -> None:
        self._drawn = time.perf_counter()
        frame = self.frames[self.at]
        past = self.frames[max(0, self.at + 1 - _PAST) : self.at + 1]
        with self._server.atomic():
            self._view.show(past, self._links, self._aspect())
            self._panel.show(past, self.at, len(self.frames), self._playing, self.status)
            if with_charts:
                self._charted = self._drawn
                self._panel.chart(past)
            centre = self._view.centre(frame) if self._follow else None
            if centre is not None:
                position = centre + self._view.radius * _BEHIND
                for client in self._server.get_clients().values():
                    client.camera.position, client.camera.look_at = position, centre
        self._server.flush()

    def _aspect(self) -> float | None:
        """Return the aspect ratio of the first browser's window; None if no browser is open."""
        cameras = [client.camera for client in self._server.get_clients().values()]
        return cameras[0].image_width / cameras[0].image_height if cameras else None

    def _failed(self, error: Exception) -> None:
        if not isinstance(error, ValueError | OSError | ModuleNotFoundError):
            traceback.print_exception(error)
        self._playing = False
        self.status = f"Not done: {error}"
        for client in self._server.get_clients().values():
            client.add_notification("Not done", str(error), auto_close_seconds=6.0, color="red")
        self._show()
