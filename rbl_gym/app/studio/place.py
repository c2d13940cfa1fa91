"""The page for placing anchors. The server has one state, which every browser shows."""

from __future__ import annotations

import dataclasses
import functools
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rbl_gym.app.studio import files, maps, searches, state
from rbl_gym.app.studio.display import Display
from rbl_gym.app.studio.figures import Others, body_figures, figures
from rbl_gym.app.studio.keeping import Keeper
from rbl_gym.app.studio.panel import Shown
from rbl_gym.app.studio.rays import on_plane, under_pointer
from rbl_gym.app.studio.state import Layout, State
from rbl_gym.app.studio.worker import Worker, in_order
from rbl_gym.app.studio.world import knobs_of
from rbl_gym.checks import FloatArray
from rbl_gym.placement.layout_files import parse_layout
from rbl_gym.studies.placing import design


class PlacePage:
    """Shows a state in a viser server, and changes it as the user asks.

    `tables` are those of the file from which the problem was read. `report` writes a report of a
    problem and a layout to a path; None: the page has no report button.
    """

    def __init__(
        self,
        server: Any,
        start: State,
        tables: Mapping[str, Any],
        folder: Path,
        report: files.Report | None = None,
        seed: int = 0,
    ) -> None:
        self._report, self._seed = report, seed
        self.state = start
        self.figures = figures(start)
        self.map = maps.slice_map(start)
        self.seconds: deque[float] = deque(maxlen=256)
        # The dragged anchor, and the state before the drag.
        self._held: tuple[int, State] | None = None
        self._selected: int | None = None
        self.status = "Drag an anchor. Click one to select it."
        self._progress: float | None = None
        self._others = Others()
        self._keeper = Keeper(start, tables, folder)
        self._worker = Worker(self._failed)
        actions = {
            "undo": lambda: self.edit(state.undo),
            "redo": lambda: self.edit(state.redo),
            "add": lambda: self._edit_and_select(state.add),
            "add_best": lambda: self._edit_and_select(lambda at: searches.add_best(at, self._seed)),
            "remove": lambda: self._of_selected(state.remove),
            "fix": lambda: self._of_selected(lambda now, k: state.fix(now, k, not now.fixed[k])),
            "optimise": self.optimise,
            "stop": self.stop_work,
            "design": self.redesign,
            "select": self.select,
            "drag": self.drag,
            "drag_body": self.drag_body,
            "cut": self.cut,
            "knobs": self.turn_knobs,
            "reset_knobs": lambda: self.turn_knobs(**knobs_of(start.world.base)._asdict()),
            "save": self.save,
            "report": self.write_report,
            "restore": self.restore,
            "load": self.load,
        }
        self._display = Display(server, start, actions, report is not None)
        self._display.panel.offer_restore(self._keeper.found is not None)
        self._worker.post(self._refine)
        threading.Thread(target=self._search, args=(start,), daemon=True).start()

    # # --- requests of the page ---------------------------------------------------------------

    @in_order()
    def edit(self, change: Callable[[State], State]) -> None:
        """Replace the state by the result of `change` and show it, in order."""
        self._edit(change)

    def drag(self, index: int, phase: str, camera: FloatArray, point: FloatArray) -> None:
        """Move an anchor to the mount under the pointer.

        `phase` is ``"start"``, ``"update"`` or ``"end"``; `camera` and `point` are two points (3,)
        of the line of sight.
        """
        asked = time.perf_counter()
        key = None if phase != "update" else ("drag", index)
        self._worker.post(lambda: self._drag(index, phase, camera, point, asked), key)

    @in_order()
    def select(self, index: int | None) -> None:
        """Select an anchor; None clears the selection."""
        self._selected = index
        self._show()

    @in_order("slice")
    def cut(self, **fields: Any) -> None:
        """Show another map; arguments are fields of `Slice`."""
        self.state = state.cut(self.state, **fields)
        self._show_coarse()
        if self._progress is None:
            self._refine()

    @in_order("body")
    def drag_body(self, _: int, phase: str, camera: FloatArray, point: FloatArray) -> None:
        """Move the body on the slice to the point under the pointer. Arguments as in `drag`."""
        low, axis = state.plane(self.state)[0], 3 - self.state.slice.up
        place = on_plane(camera, point, axis, low[axis])
        self.state = state.place_body(self.state, place)
        self.figures = self.figures._replace(body=body_figures(self.state))
        self._show()

    def turn_knobs(self, **knobs: float) -> None:
        """Change `Knobs`, given by name."""

        def task() -> None:
            self.state = state.turn_knobs(self.state, **knobs)
            self._end_work()
            self._show_coarse()
            self._refine()

        self._worker.post(task, ("knobs", *knobs))

    @in_order()
    def optimise(self) -> None:
        """Improve the current layout step by step. Any change ends this."""
        self._progress, self.status = 0.0, "Optimising ..."
        self._show()
        self._worker.when_idle(self._improve(self.state))

    @in_order()
    def stop_work(self) -> None:
        """Stop the running work and keep its result."""
        self._end_work()
        self.status = "Stopped."
        self._show()
        self._refine()

    @in_order()
    def redesign(self) -> None:
        """Show the designed layout for this number of anchors. Search it first if needed."""
        now = self.state
        found = self._others.designed.get((now.world.knobs, len(now.anchors)))
        if found is not None and not now.fixed.any():
            self._edit(lambda at: state.set_layout(at, Layout(found, at.fixed)))
            return
        self.status = "Searching for the best layout from scratch ..."
        self._show()
        threading.Thread(target=self._search, args=(now, True), daemon=True).start()

    @in_order()
    def save(self, name: str) -> None:
        """Write the scene file and the mounting list into the folder."""
        paths = self._keeper.save(self.state, name)
        self._say("Saved", files.names(paths), "teal")

    @in_order()
    def load(self, name: str, content: bytes) -> None:
        """Replace the anchors by those of a list (CSV)."""
        places = parse_layout(name, content).positions
        loaded = state.open_state(self.state.world.base, places).layout
        self._edit(lambda now: state.set_layout(now, loaded))
        self.status = f"{len(places)} anchors of {name}."

    def write_report(self, name: str) -> None:
        """Run `save` and write the report in the background."""
        now, report = self.state, self._report
        assert report is not None  # else the page has no report button

        def task() -> None:
            try:
                paths = self._keeper.save_report(now, name, report)
            except Exception as error:
                self._worker.post(functools.partial(self._failed, error))
            else:
                self._worker.post(lambda: self._say("Saved", files.names(paths), "teal"))

        self._worker.post(lambda: self._say("Report", f"{name}.pdf is being made", "gray"))
        threading.Thread(target=task, daemon=True).start()

    def restore(self) -> None:
        """Restore the layout of the last session."""
        anchors = self._keeper.found
        if anchors is not None:
            restored = Layout(anchors, np.zeros(len(anchors), bool))
            self.edit(lambda now: state.set_layout(now, restored))
            self._display.panel.offer_restore(False)

    def settle(self, timeout: float = 60.0) -> bool:
        """Wait until all requests are shown; return whether this was within the time limit."""
        return self._worker.settle(timeout)

    def stop(self) -> None:
        """Save the layout and stop the worker."""
        self._worker.post(lambda: self._keeper.keep(self.state))
        self._worker.stop()

    # --- tasks of the worker ----------------------------------------------------------------

    def _edit(self, change: Callable[[State], State]) -> None:
        before = self.state
        self.state = change(before)
        self._held = None
        self._end_work()
        if self._selected is not None and self._selected >= len(self.state.anchors):
            self._selected = None
        self.status = "Nothing to change." if self.state is before else ""
        self._show_coarse()
        self._refine()

    @in_order()
    def _edit_and_select(self, change: Callable[[State], State]) -> None:
        count = len(self.state.anchors)
        self._edit(change)
        if len(self.state.anchors) > count:
            self._selected = len(self.state.anchors) - 1
            self.status = f"Anchor {self._selected + 1} added."
            self._show()

    @in_order()
    def _of_selected(self, change: Callable[[State, int], State]) -> None:
        index = self._selected
        if index is None:
            raise ValueError("no anchor is selected: click one first")
        self._edit(lambda now: change(now, index))

    def _drag(
        self, index: int, phase: str, camera: FloatArray, point: FloatArray, asked: float
    ) -> None:
        if phase == "start" and self._held is None:
            self._held, self._selected = (index, self.state), index
            self._end_work()
        if self._held is None or self._held[0] != index:
            return
        start = self._held[1]
        if phase == "end":
            self._held, self.status = None, ""
            if start.fixed[index]:
                self._say("Fixed", f"Anchor {index + 1} is fixed: release it first.", "orange")
        if not start.fixed[index]:
            place = under_pointer(self.state.world, camera, point, self.state.anchors[index])
            moved = state.move(start, index, place)
            # Over an obstacle the anchor keeps its last position.
            if moved is not start:
                self._adopt(moved)
            self._show_coarse()
            self.seconds.append(time.perf_counter() - asked)
        if phase == "end":
            self._refine()

    def _adopt(self, other: State) -> None:
        """Take the layout of another state, with its undo history."""
        fields = {name: getattr(other, name) for name in ("layout", "past", "future")}
        self.state = dataclasses.replace(self.state, **fields)

    def _improve(self, start: State) -> Iterator[None]:
        before = start.score
        for done, better in searches.optimise(start, self._seed):
            self._adopt(better)
            self._progress = done
            self._show_coarse()
            self._keeper.keep_meanwhile(self.state)
            yield
        gain = 100 * (1 - self.state.score / before)
        self._end_work()
        self.status = "No step improves this layout."
        if gain >= 0.05:
            self.status = f"Optimised: b is {gain:.1f} % smaller."
        self._show()
        self._refine()

    def _end_work(self) -> None:
        """Stop an optimisation and keep its result."""
        if self._progress is not None:
            self._progress, self.status = None, ""
        self._worker.when_idle(None)

    # --- showing ----------------------------------------------------------------------------

    def _show_coarse(self) -> None:
        self.map = maps.slice_map(self.state, before=self.map)
        self.figures = figures(self.state, few=True)
        self._show()

    def _refine(self) -> None:
        self._worker.when_idle(self._refined())

    def _refined(self) -> Iterator[None]:
        self.figures = figures(self.state)
        self._show()
        yield
        self.map = maps.slice_map(self.state, maps.REFINED).beside(self.map)
        self._show()
        yield
        self._keeper.keep(self.state)
        yield
        self._others.search_usual(self.state.world, len(self.state.anchors))
        self._show()

    def _show(self) -> None:
        now = self.state
        others = self._others.scores(now.world, len(now.anchors))
        marks = self._selected, self._progress, self.status
        self._display.show(Shown(now, self.figures, self.map, others, *marks))

    # # --- background threads -----------------------------------------------------------------

    def _search(self, now: State, apply: bool = False) -> None:
        """Design a layout to replace this one, around the fixed anchors, or for comparison."""
        world, count = now.world, len(now.anchors)
        try:
            found = design.design_layout(now.problem, self._seed).anchors
        except Exception as error:
            self._worker.post(functools.partial(self._failed, error))
            return

        def task() -> None:
            if not apply or not now.fixed.any():
                self._others.designed[world.knobs, count] = found
            if apply:
                stays = np.arange(count) < now.fixed.sum()
                self._edit(lambda at: state.set_layout(at, Layout(found, stays)))
            else:
                self._show()

        self._worker.post(task)

    def _say(self, title: str, text: str, colour: str) -> None:
        self.status = f"{title}: {text}"
        self._display.notify(title, text, colour)
        self._show()

    def _failed(self, error: Exception) -> None:
        if not isinstance(error, ValueError | OSError | ModuleNotFoundError):
            traceback.print_exception(error)
        self._end_work()
        self._say("Not done", str(error) or type(error).__name__, "red")
