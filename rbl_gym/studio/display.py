"""All that a browser shows of a layout: the scene in 3-D and the panel beside it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from rbl_gym.studio import files, scene_view
from rbl_gym.studio.panel import Panel, Shown
from rbl_gym.studio.state import State

# A message goes away after so long, seconds.
_MESSAGE_S = 6.0


class Display:
    """Draws what does not change, and then every `Shown`.

    Parameters
    ----------
    server
        The viser server.
    start
        What is shown first.
    actions
        As `Panel` takes them; and ``drag``, as `scene_view.AnchorView` calls it.
    has_report
        Whether there is a button for the report.
    """

    def __init__(
        self,
        server: Any,
        start: State,
        actions: Mapping[str, Callable[..., None]],
        has_report: bool = False,
    ) -> None:
        self._server = server
        problem = start.world.problem
        self._extent = scene_view.extent_of(problem)
        self._image: Any = None
        self._image_at: Any = None
        self._zones_shown: Any = None
        scene_view.set_camera(server, problem)
        scene_view.draw_room(server, problem)
        self.anchors = scene_view.AnchorView(
            server, self._extent, actions["drag"], actions["select"]
        )
        self.panel = Panel(server.gui, start, files.default_name(problem), actions, has_report)

    def show(self, shown: Shown) -> None:
        """Show all of it; what has not changed is not sent."""
        now = shown.state
        with self._server.atomic():
            at = (*shown.map.low, *shown.map.high, shown.map.up)
            image = self._image if self._image_at == at else None
            self._image, self._image_at = scene_view.draw_map(self._server, shown.map, image), at
            self.anchors.show(now.anchors, now.fixed, shown.selected)
            self.panel.show(shown)
            self._show_zones(shown)
        self._server.flush()

    def _show_zones(self, shown: Shown) -> None:
        zones = shown.figures.zones, shown.state.world.knobs
        if zones == self._zones_shown:
            return
        self._zones_shown = zones
        problem = shown.state.world.problem
        scene_view.draw_zones(self._server, problem, shown.figures.zones)
        low, high = problem.zones[0].bounds()
        scene_view.draw_body(self._server, problem.tags, 0.5 * (low + high), self._extent)

    def notify(self, title: str, text: str, colour: str) -> None:
        """A message in every browser that is open."""
        for client in self._server.get_clients().values():
            client.add_notification(title, text, auto_close_seconds=_MESSAGE_S, color=colour)
