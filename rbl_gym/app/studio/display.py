"""The display of a layout in a browser: the scene in 3-D and the panel beside it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from rbl_gym.app.studio import files, moving_view, scene_view
from rbl_gym.app.studio.panel import Panel, Shown
from rbl_gym.app.studio.state import State

# Minimum displayed size of the body: shares of the extents of the room and of all zones.
_BODY, _OF_ZONES = 0.03, 0.12
# Time after which a message disappears, seconds.
_MESSAGE_S = 6.0


class Display:
    """Draws the static parts once, then every `Shown`.

    `actions` are those of `Panel`, and ``drag`` and ``drag_body``, which `moving_view.AnchorView`
    and `BodyView` call.
    """

    def __init__(
        self,
        server: Any,
        start: State,
        actions: Mapping[str, Callable[..., None]],
        has_report: bool = False,
    ) -> None:
        self._server, scene = server, server.scene
        problem = start.world.problem
        extent = scene_view.extent_of(problem)
        zones = float(np.ptp(problem.corners(), axis=0).max())
        scene_view.set_camera(server, problem)
        scene_view.draw_room(server, problem)
        self._map = moving_view.MapView(scene)
        self._zones = moving_view.ZoneView(scene, problem.zones)
        self._body = moving_view.BodyView(
            scene, min(_BODY * extent, _OF_ZONES * zones), actions["drag_body"]
        )
        self._anchors = moving_view.AnchorView(scene, extent, actions["drag"], actions["select"])
        self.panel = Panel(server.gui, start, files.default_name(problem), actions, has_report)

    def show(self, shown: Shown) -> None:
        """Show the complete content. Only the changes are sent."""
        now, figures = shown.state, shown.figures
        with self._server.atomic():
            self._map.show(shown.map)
            self._anchors.show(now.anchors, now.fixed, shown.selected)
            self._body.show(now.world.problem.tags, now.body, now.anchors, figures.body.seen)
            self._zones.show(figures.zones)
            self.panel.show(shown)
        self._server.flush()

    def notify(self, title: str, text: str, colour: str) -> None:
        """Show a message in every open browser."""
        for client in self._server.get_clients().values():
            client.add_notification(title, text, auto_close_seconds=_MESSAGE_S, color=colour)
