"""The panel for watching: figures, charts, the player, disturbances. It computes nothing."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from rbl_gym.app.studio.panel import length, when_changed
from rbl_gym.app.studio.watch_view import FILTERS, GHOSTS, LINK_COLOURS, TRUTH, swatches
from rbl_gym.checks import FloatArray
from rbl_gym.studies.watching.frames import LINKS, Frame
from rbl_gym.studies.watching.live import CALM, Disturbances
from rbl_gym.studies.watching.program import Program

# Width of the charts, pixels.
CHARTS_WIDTH = 270
NONE = "none"
# Filters on offer; the command accepts any other name.
OFFERED = (
    "iekf",
    "iekf/robust=true",
    "iekf/robust=late",
    "uc-kf",
    "kf",
    "et-kf",
    "iekf-bias",
    "iekf-bank",
)
# Error of the wrong anchor position in metres, and the factor on the noise.
WRONG_M, NOISIER = 0.5, 2.0
# Epochs over which the table averages NIS.
_RECENT = 10
# Mean NIS per degree of freedom above which a filter is overconfident.
_TOO_SURE = 1.5
_CSS = (
    "font-family:inherit;font-size:12.5px;line-height:1.45;color:#212529;"
    "font-variant-numeric:tabular-nums;padding:0 12px 4px 10px"
)
# Charts: name, minimum displayed value, quantity of a track.
CHARTS: Mapping[str, tuple[float, Callable[[Any], float]]] = {
    "Position error (m)": (1e-3, lambda track: track.position_m),
    "Rotation error (deg)": (1e-2, lambda track: track.rotation_deg),
    "NIS per range (consistent: 1)": (1e-1, lambda track: track.nis_ratio),
}


def offered(filters: Sequence[str]) -> tuple[str, ...]:
    """Return the labels that the page offers: those of the program, then `OFFERED`."""
    return tuple(dict.fromkeys((*filters, *OFFERED)))


def chosen(labels: Sequence[str], filters: Sequence[str]) -> tuple[str, ...]:
    """Return the different labels that are offered, or `filters` if there are none.

    A client may send any text, and ``MODULE:FACTORY`` would be imported.
    """
    known = [label for label in labels if label in offered(filters)]
    return tuple(dict.fromkeys(known)) or tuple(filters)


class WatchPanel:
    """Controls of the panel, in the GUI of a viser server.

    `actions` are callbacks by name: ``play``, ``step``, ``restart`` without arguments; ``speed``
    with a factor; ``seek`` with the number of a frame; ``begin`` with labels of filters and a seed;
    ``disturb`` with `Disturbances`; ``links`` with the index of a filter; ``follow`` with True if
    the camera follows the body.
    """

    def __init__(
        self, gui: Any, program: Program, actions: Mapping[str, Callable[..., None]]
    ) -> None:
        self._gui, self._program = gui, program
        self._filters = program.filters
        self._disturbed: tuple[Any, ...] = ()
        self._table = gui.add_html("")
        self._play = gui.add_button("Play", icon="player-play")
        self._play.on_click(lambda _: actions["play"]())
        move = gui.add_button_group("", ("Step", "Restart"))
        move.on_click(lambda _: actions[move.value.lower()]())
        self._time = gui.add_slider("Epoch", 0, 1, 1, 0)
        when_changed(self._time, lambda: actions["seek"](int(self._time.value)))
        speed = gui.add_button_group("Speed", ("0.5x", "1x", "4x", "max"))
        factors = {"0.5x": 0.5, "1x": 1.0, "4x": 4.0, "max": np.inf}
        speed.on_click(lambda _: actions["speed"](factors[speed.value]))
        if program.can_disturb:
            with gui.add_folder("Disturb"):
                self._add_disturbances(gui, actions["disturb"])
        with gui.add_folder("View"):
            follow = gui.add_checkbox("Follow body", False)
            when_changed(follow, lambda: actions["follow"](bool(follow.value)))
            self._seen_by = gui.add_dropdown("Links of", self._filters or (NONE,))
            self._seen_by.visible = len(self._filters) > 1
            when_changed(
                self._seen_by, lambda: actions["links"](self._filters.index(self._seen_by.value))
            )
            gui.add_html(_legend())
        if program.can_seed or program.can_choose:
            with gui.add_folder("Begin anew"):
                self._add_beginning(gui, actions["begin"])
        self._status = gui.add_html("")
        self._charts = self._add_charts(gui) if self._filters else []

    def _add_charts(self, gui: Any) -> list[Any]:
        """Add charts in a panel of their own, to the left."""
        panel = gui.add_panel()
        with panel.add_tab("Errors"):
            charts = [self._chart(gui, name) for name in CHARTS]
        panel.dock_left()
        panel.set_width(CHARTS_WIDTH)
        return charts

    def _add_disturbances(self, gui: Any, disturb: Callable[[Disturbances], None]) -> None:
        nlos = gui.add_slider("Reflected (%)", 0, 50, 1, 0)
        lost = gui.add_slider("Lost (%)", 0, 95, 1, 0)
        wrong = gui.add_checkbox(
            "Wrong anchor",
            False,
            hint=f"Filters assume a position of anchor 1 that is {WRONG_M:g} m off",
        )
        noise = gui.add_checkbox(f"Noise x {NOISIER:g}", False)
        handles = self._disturbed = (nlos, lost, wrong, noise)

        def changed() -> None:
            disturb(
                Disturbances(
                    nlos.value / 100,
                    lost.value / 100,
                    WRONG_M if wrong.value else 0.0,
                    NOISIER if noise.value else 1.0,
                )
            )

        for handle in handles:
            when_changed(handle, changed)
        calm = gui.add_button("None of these", color="gray")
        calm.on_click(lambda _: disturb(CALM))

    def _add_beginning(self, gui: Any, begin: Callable[..., None]) -> None:
        program, boxes = self._program, []
        if program.can_choose:
            names = offered(program.filters)
            boxes = [
                gui.add_dropdown("Filter", names, initial_value=program.filters[0]),
                gui.add_dropdown(
                    "Beside it", (NONE, *names), initial_value=(*program.filters, NONE)[1]
                ),
            ]
        seed = gui.add_number("Seed", program.seed, min=0, max=2**31 - 1, step=1)

        def changed() -> None:
            begin(chosen([box.value for box in boxes], program.filters), int(seed.value))

        for handle in (*boxes, seed):
            when_changed(handle, changed)

    def _chart(self, gui: Any, name: str) -> Any:
        from viser import uplot

        data, series = self._curves((), 0.0, lambda _: np.nan)
        look: Any = {"font": "10px sans-serif", "stroke": "#495057"}
        grid = uplot.Axis_Grid(stroke="#e9ecef", width=1)
        ticks = uplot.Axis_Ticks(show=False)
        return gui.add_uplot(
            data, series,
            title=name,
            scales={"x": uplot.Scale(time=False), "y": uplot.Scale(distr=3)},
            axes=tuple(
                uplot.Axis(size=size, grid=grid, ticks=ticks, **look) for size in (26, 40)
            ),
            legend=uplot.Legend(show=False),
            cursor=uplot.Cursor(show=False),
            height=160,
            padding=(8, 10, 0, 0),
        )  # fmt: skip

    def _curves(
        self, frames: Sequence[Frame], least: float, of: Callable[[Any], float]
    ) -> tuple[tuple[FloatArray, ...], tuple[Any, ...]]:
        from viser import uplot

        times = np.array([frame.time_s for frame in frames] or [0.0, 1.0])
        curves = []
        for k in range(len(self._filters)):
            values = np.array([of(frame.tracks[k]) for frame in frames] or [np.nan, np.nan])
            curves.append(np.maximum(values, least))
        looks = [
            uplot.Series(label=label, stroke=f"rgb{FILTERS[k]}", width=1.5)
            for k, label in enumerate(self._filters)
        ]
        return (times, *curves), (uplot.Series(label="s"), *looks)

    # # --- content ---------------------------------------------------------------------------

    def show(self, past: Sequence[Frame], at: int, count: int, playing: bool, status: str) -> None:
        """Show the figures of the last of the frames, which is number `at` of `count`."""
        self._table.content = headline(self._program.title, past)
        icon, label = ("player-pause", "Pause") if playing else ("player-play", "Play")
        if self._play.label != label:
            self._play.label, self._play.icon = label, icon
        if self._time.max != max(count - 1, 1):
            self._time.max = max(count - 1, 1)
        if self._time.value != at:
            self._time.value = at
        self._status.content = f'<div style="{_CSS}">{html.escape(status)}</div>'

    def show_disturbances(self, now: Disturbances) -> None:
        """Show the present disturbances."""
        values = round(100 * now.nlos), round(100 * now.lost), now.wrong_m > 0, now.noise > 1
        for handle, value in zip(self._disturbed, values, strict=False):
            if handle.value != value:
                handle.value = value

    def chart(self, frames: Sequence[Frame]) -> None:
        """Show these frames in the charts."""
        for chart, (least, of) in zip(self._charts, CHARTS.values(), strict=False):
            chart.data = self._curves(frames, least, of)[0]

    def name_filters(self, labels: tuple[str, ...]) -> None:
        """Replace the names of the filters."""
        self._filters = labels
        self._seen_by.options = labels or (NONE,)
        self._seen_by.visible = len(labels) > 1
        for chart in self._charts:
            chart.data, chart.series = self._curves((), 0.0, lambda _: np.nan)


def headline(title: str, frames: Sequence[Frame]) -> str:
    """Return title, time, links and figures of the filters at the last of some frames (HTML)."""
    frame = frames[-1]
    links = frame.links
    parts = [
        f'<div style="{_CSS}"><div style="display:flex;justify-content:space-between">'
        f'<b style="font-size:15px">{html.escape(title)}</b><span>{frame.time_s:.1f} s</span></div>'
    ]
    if links.measured.size:
        total, got = links.measured.size, int(links.measured.sum())
        reflected = int((links.measured & links.reflected).sum())
        told = f"{got} of {total} ranges"
        parts.append(f"<div>{told}{f', {reflected} reflected' if reflected else ''}</div>")
    if np.isfinite(frame.score_m):
        parts.append(f"<div>score b <b>{length(frame.score_m)}</b></div>")
    for k, (name, score) in enumerate(frame.scores.items()):
        shown = length(score) if np.isfinite(score) else "-"
        colour = GHOSTS[k % len(GHOSTS)]
        parts.append(f'<div style="color:rgb{colour}">{html.escape(name)}: {shown}</div>')
    parts += [_filter_row(k, frames[-_RECENT:]) for k in range(len(frame.tracks))]
    return "".join([*parts, "</div>"])


def _filter_row(k: int, recent: Sequence[Frame]) -> str:
    track = recent[-1].tracks[k]
    ratios = [frame.tracks[k].nis_ratio for frame in recent if k < len(frame.tracks)]
    ratio = float(np.mean(ratios)) if np.isfinite(ratios).any() else np.nan
    figures = []
    if np.isfinite(track.position_m):
        figures.append(length(track.position_m))
    if np.isfinite(track.rotation_deg):
        figures.append(f"{track.rotation_deg:.1f}&deg;")
    rejected = int(track.rejected.sum())
    if rejected:
        figures.append(f"{rejected} rejected")
    verdict, colour = "", "#495057"
    if np.isfinite(ratio):
        verdict, colour = f"NIS {ratio:.1f}", "#2b8a3e" if ratio < _TOO_SURE else "#c92a2a"
    return (
        f'<div style="border-left:4px solid rgb{FILTERS[k]};padding-left:7px;margin:5px 0">'
        '<div style="display:flex;justify-content:space-between">'
        f"<b>{html.escape(track.label)}</b>"
        f'<b style="color:{colour}">{verdict}</b></div>'
        f'<div style="color:#495057">{", ".join(figures)}</div></div>'
    )


def _legend() -> str:
    links = dict(zip(LINKS, LINK_COLOURS, strict=True))
    return f'<div style="{_CSS}">{swatches({"true body": TRUTH, **links})}</div>'
