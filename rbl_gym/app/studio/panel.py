"""The panel beside the scene: figures, buttons, sliders. It computes no figure."""

from __future__ import annotations

import html
import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.app.studio.figures import Figures, ZoneFigures
from rbl_gym.app.studio.maps import BEYOND, QUANTITIES, WITHIN, SliceMap, css_gradient
from rbl_gym.app.studio.moving_view import SEEN, SIGNS, VERDICTS
from rbl_gym.app.studio.state import State

PLANES = {"Floor plan (x, y)": 1, "Section (x, z)": 2}
_NOBODY = "none"
# Number of recent values of an input that are remembered.
_MOST_ASKED = 64
_CSS = (
    "font-family:inherit;font-size:12.5px;line-height:1.4;color:#212529;"
    "font-variant-numeric:tabular-nums;padding:0 12px 0 10px"
)


class Shown(NamedTuple):
    """The content of the panel.

    `others` are b of other layouts by name, metres; None: not known yet. `progress` is from 0 to 1,
    or None. `status` is one line.
    """

    state: State
    figures: Figures
    map: SliceMap
    others: Mapping[str, float | None]
    selected: int | None
    progress: float | None
    status: str


class Panel:
    """Controls of the panel, in the GUI of a viser server.

    `actions` are callbacks by name: ``undo``, ``redo``, ``add``, ``add_best``, ``remove``, ``fix``,
    ``optimise``, ``stop``, ``design``, ``reset_knobs``, ``restore`` without arguments; ``select``
    with an index or None; ``cut`` and ``knobs`` with keywords; ``save`` and ``report`` with a name,
    ``load`` with a file's name and its bytes.
    """

    def __init__(
        self,
        gui: Any,
        state: State,
        name: str,
        actions: Mapping[str, Callable[..., None]],
        has_report: bool = False,
    ) -> None:
        self._gui, self._actions = gui, actions
        self._asked: dict[int, deque[Any]] = {}
        self._headline = gui.add_html("")
        self._optimise = self._button("Optimise from here", "optimise", icon="trending-down")
        self._optimise.hint = (
            "Move all free anchors step by step until the error no longer decreases"
        )
        self._stop = self._button("Stop", "stop", icon="player-stop", color="gray")
        self._progress = gui.add_progress_bar(0.0, visible=False)
        self._group("History", {"Undo": "undo", "Redo": "redo"})
        self._status = gui.add_html("")
        with gui.add_folder("Anchors"):
            self._selected = gui.add_dropdown("Selected", (_NOBODY,))
            self._one = self._group("", {"Fix / release": "fix", "Remove": "remove"})
            self._add = self._group("One more", {"Best place": "add_best", "Anywhere": "add"})
            self._all = self._group("All", {"Design afresh": "design"})
        with gui.add_folder("Map"):
            self._quantities = {
                q.name: key
                for key, q in QUANTITIES.items()
                if key != "requirement" or any(z.has_requirement for z in state.world.base.zones)
            }
            shown = QUANTITIES[state.slice.quantity].name
            self._quantity = gui.add_dropdown("Show", tuple(self._quantities), initial_value=shown)
            self._plane = gui.add_dropdown("Slice", tuple(PLANES))
            self._at = gui.add_slider("At", 0.0, 1.0, 0.01, 0.5)
            self._legend = gui.add_html("")
        with gui.add_folder("What if", expand_by_default=False):
            knobs = state.world.knobs
            self._noise = gui.add_slider(
                "Noise (m)", *_range(knobs.noise_m, 4 * knobs.noise_m), knobs.noise_m
            )
            self._tags = gui.add_slider("Tags", 3, max(12, knobs.n_tags), 1, knobs.n_tags)
            self._size = gui.add_slider(
                "Body (m)", *_range(knobs.size_m, 3 * knobs.size_m), knobs.size_m
            )
            self._loss = gui.add_slider("Walls (dB)", 0.0, 60.0, 0.5, round(knobs.loss_db, 2))
            self._loss.visible = bool(state.world.base.obstacles)
            self._button("As in the file", "reset_knobs", color="gray")
        with gui.add_folder("Save", expand_by_default=False):
            self._name = gui.add_text("Name", name)
            save = gui.add_button("Scene and list", icon="device-floppy")
            save.hint = "NAME.toml for rbl-gym place and studio, NAME.csv as mounting list"
            save.on_click(lambda _: actions["save"](self._name.value))
            if has_report:
                report = gui.add_button("Report (PDF)", icon="file-text")
                report.on_click(lambda _: actions["report"](self._name.value))
            self._restore = self._button("Restore the last session", "restore", color="gray")
            self._restore.visible = False
            lists = gui.add_upload_button("Load a list (CSV)", icon="upload", mime_type=".csv")
            lists.on_upload(lambda _: actions["load"](lists.value.name, lists.value.content))
        for action, key in (("undo", "Z"), ("redo", "Y")):
            command = gui.add_command(action.capitalize(), hotkey=key, modifier="cmd/ctrl")
            command.on_trigger(lambda _, action=action: self._actions[action]())
        self._listen()

    def _button(self, label: str, action: str, **style: Any) -> Any:
        button = self._gui.add_button(label, **style)
        button.on_click(lambda _: self._actions[action]())
        return button

    def _group(self, label: str, labels: Mapping[str, str]) -> Any:
        group = self._gui.add_button_group(label, tuple(labels))
        group.on_click(lambda _: self._actions[labels[group.value]]())
        return group

    def _listen(self) -> None:
        self._input(self._selected, lambda: self._actions["select"](self._selection()))
        self._input(
            self._quantity,
            lambda: self._actions["cut"](quantity=self._quantities[self._quantity.value]),
        )
        self._input(self._plane, lambda: self._actions["cut"](up=PLANES[self._plane.value]))
        self._input(self._at, lambda: self._actions["cut"](share=self._share()))
        for name, handle in self._knobs().items():
            self._input(handle, lambda n=name, h=handle: self._actions["knobs"](**{n: h.value}))

    def _input(self, handle: Any, call: Callable[[], None]) -> None:
        """Connect a callback that runs if a user changes an input, but not if `show` does."""
        asked = self._asked[id(handle)] = deque(maxlen=_MOST_ASKED)

        def changed() -> None:
            asked.append(handle.value)
            call()

        when_changed(handle, changed)

    def _fill(self, handle: Any, value: Any) -> None:
        """Show a value in an input, unless a user asked for it.

        While a user moves a slider, the state lags behind by some values. It must not move the
        slider back.
        """
        asked = self._asked[id(handle)]
        if not any(_same(value, one) for one in (handle.value, *asked)):
            asked.clear()
            handle.value = value

    def _share(self) -> float:
        low, high = float(self._at.min), float(self._at.max)
        return (float(self._at.value) - low) / (high - low) if high > low else 0.5

    def _knobs(self) -> dict[str, Any]:
        return {
            "noise_m": self._noise,
            "n_tags": self._tags,
            "size_m": self._size,
            "loss_db": self._loss,
        }

    def _selection(self) -> int | None:
        text = str(self._selected.value)
        return None if text == _NOBODY else int(text.split()[0]) - 1

    # # --- content ---------------------------------------------------------------------------

    def offer_restore(self, visible: bool) -> None:
        """Show or hide the button that restores the last session."""
        self._restore.visible = visible

    def show(self, shown: Shown) -> None:
        """Show the complete content."""
        state, selected = shown.state, shown.selected
        _set(self._headline, "content", headline(shown))
        _set(self._legend, "content", legend(shown.map))
        _set(self._status, "content", status(shown))
        running = shown.progress is not None
        for handle in (self._stop, self._progress):
            _set(handle, "visible", running)
        _set(self._optimise, "visible", not running)
        _set(self._progress, "value", 100.0 * (shown.progress or 0.0))
        names = [_NOBODY, *(_anchor_name(state, k) for k in range(len(state.anchors)))]
        if _set(self._selected, "options", tuple(names)):
            self._asked[id(self._selected)].clear()
        self._fill(self._selected, names[0 if selected is None else selected + 1])
        _set(self._one, "visible", selected is not None)
        self._fill(self._quantity, QUANTITIES[state.slice.quantity].name)
        self._fill(self._plane, next(k for k, up in PLANES.items() if up == state.slice.up))
        self._show_at(state)
        for name, handle in self._knobs().items():
            self._fill(handle, getattr(state.world.knobs, name))

    def _show_at(self, state: State) -> None:
        """Show the position of the slice, in metres along its normal axis."""
        axis = 3 - state.slice.up
        low, high = (float(corner[axis]) for corner in state.world.base.corners())
        _set(self._at, "visible", high > low)
        if high > low:
            if _set(self._at, "label", f"At {'xyz'[axis]} (m)"):
                self._asked[id(self._at)].clear()
            for name, value in (("min", low), ("max", high), ("step", (high - low) / 100)):
                _set(self._at, name, value)
            self._fill(self._at, round(low + state.slice.share * (high - low), 6))


def _set(handle: Any, name: str, value: Any) -> bool:
    """Set a property, and return whether it changed. An unchanged value is not sent."""
    if getattr(handle, name) == value:
        return False
    setattr(handle, name, value)
    return True


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, str) or isinstance(other, str):
        return one == other
    return math.isclose(one, other, rel_tol=1e-5, abs_tol=1e-6)


def _range(value: float, most: float) -> tuple[float, float, float]:
    """Return minimum, maximum and step of a slider whose range includes `value`."""
    step = 10.0 ** int(np.floor(np.log10(max(value, 1e-9)))) / 20
    return step, round(round(most / step) * step, 9), step


def _anchor_name(state: State, index: int) -> str:
    return f"{index + 1}  fixed" if state.fixed[index] else f"{index + 1}"


def when_changed(handle: Any, call: Callable[[], None]) -> None:
    """Connect a callback that runs if a user changes an input, but not if the page does."""

    def changed(event: Any) -> None:
        if event.client is not None:
            call()

    handle.on_update(changed)


def _text(text: str) -> str:
    return html.escape(text)


# --- parts of the page -----------------------------------------------------------------------


def headline(shown: Shown) -> str:
    """The score, the zones, the body, and the scores of other layouts as bars."""
    figures, count = shown.figures, len(shown.state.anchors)
    body = figures.body
    seen = int((body.seen >= SEEN).sum())
    parts = [
        f'<div style="{_CSS};padding-bottom:8px">',
        '<div style="display:flex;align-items:baseline;gap:8px">'
        f'<b style="font-size:26px;line-height:1.25">{length(figures.score_m)}</b>'
        f'<span style="color:#495057">tag error b, {count} anchors</span></div>',
        *(_zone(zone) for zone in figures.zones),
        _row(
            "#fcc419",
            "At the body",
            f"{length(body.position_m)}, {body.heading_deg:.1f}°; "
            f"{seen} of {count} anchors in sight",
        ),
        _bars(figures.score_m, shown.others),
        "</div>",
    ]
    return "".join(parts)


def _zone(zone: ZoneFigures) -> str:
    colour, share = f"rgb{VERDICTS[zone.verdict]}", ""
    if np.isfinite(zone.share):
        share = (
            f'<b style="color:{colour};white-space:nowrap">{SIGNS[zone.verdict]} '
            f"{100 * zone.share:.1f} % of {100 * zone.required:g} %</b>"
        )
    figures = (
        f"{length(zone.position_m)} horizontal, {length(zone.height_m)} height, "
        f"{zone.heading_deg:.1f}°"
    )
    return _row(colour, zone.name, figures, share)


def _row(colour: str, name: str, figures: str, right: str = "") -> str:
    """A name, figures below it, and a mark (HTML) to the right."""
    return (
        f'<div style="border-left:4px solid {colour};padding-left:7px;margin:5px 0">'
        '<div style="display:flex;justify-content:space-between;gap:6px">'
        f'<span style="overflow-wrap:anywhere">{_text(name)}</span>{right}</div>'
        f'<div style="color:#495057;font-size:11.5px">{_text(figures)}</div></div>'
    )


def _bars(own: float, others: Mapping[str, float | None]) -> str:
    """This layout among the others, the best first, each with a bar of its score."""
    known = {name: score for name, score in others.items() if score is not None}
    rows = sorted([("this layout", own), *known.items()], key=lambda row: row[1])
    largest = max(score for _, score in rows)
    lines = []
    for name, score in rows:
        mine = name == "this layout"
        colour, weight = ("#e8590c", "600") if mine else ("#adb5bd", "400")
        lines.append(
            f'<span style="font-weight:{weight};white-space:nowrap">{_text(name)}</span>'
            '<span style="background:#f1f3f5;border-radius:2px;height:8px;align-self:center">'
            f'<span style="display:block;height:8px;border-radius:2px;background:{colour};'
            f'width:{100 * score / largest:.1f}%"></span></span>'
            f'<span style="font-weight:{weight};text-align:right">{length(score)}</span>'
        )
    for name in others:
        if name not in known:
            lines.append(
                f'<span style="color:#868e96">{_text(name)}</span>'
                '<span style="color:#868e96">is being searched</span><span></span>'
            )
    return (
        '<div style="display:grid;grid-template-columns:auto 1fr auto;gap:0 8px;margin-top:6px;'
        f'font-size:11.5px;line-height:1.45">{"".join(lines)}</div>'
    )


def status(shown: Shown) -> str:
    """The last message, in red if an action failed."""
    colour = "#c92a2a" if shown.status.startswith("Not done") else "#495057"
    return f'<div style="{_CSS};color:{colour};min-height:18px">{_text(shown.status)}</div>'


def legend(found: SliceMap) -> str:
    """The colours of the map."""
    quantity = found.quantity
    if quantity is QUANTITIES["requirement"]:
        squares = "".join(
            f'<span style="display:inline-block;width:10px;height:10px;background:rgb{colour};'
            f'margin:0 4px 0 8px"></span>{word}'
            for colour, word in ((WITHIN, "within"), (BEYOND, "beyond"))
        )
        return f'<div style="{_CSS}">{squares}</div>'
    low, high = (
        length(value) if quantity.unit == "m" else f"{value:.2g}°" for value in found.limits
    )
    return (
        f'<div style="{_CSS}"><div style="height:10px;border-radius:2px;'
        f'background:{css_gradient()}"></div>'
        '<div style="display:flex;justify-content:space-between">'
        f"<span>{low}</span><span>{high}</span></div></div>"
    )


def length(metres: float) -> str:
    """Format a length with at most three digits, in a suitable unit."""
    for unit, scale in (("mm", 1000), ("cm", 100), ("m", 1)):
        value = scale * metres
        if value < (10 if unit == "mm" else 100):
            return f"{value:.1f} {unit}" if unit != "m" or value >= 10 else f"{value:.2f} m"
    return f"{metres:.0f} m"
