"""A tracked body as an HTML page: 3-D view and close-up with a time slider, errors, NEES."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from rbl_gym.app import page, solids
from rbl_gym.app.story import Story, chart_limits, enlargement, errors_of, freedom_of
from rbl_gym.checks import FloatArray
from rbl_gym.geometry import rotations
from rbl_gym.rendering.drawing import ANCHOR, AXES, INK, body_edges, gapped
from rbl_gym.studies.epochs import nees_interval
from rbl_gym.studies.replay.figures import gaps_of

# Moments of the slider, and epochs of the curves; longer tracks are thinned out.
_MOMENTS, _POINTS = 120, 1500


def track_figure(story: Story) -> go.Figure:
    """Return the 3-D view, a close-up, and with truth errors and NEES; with a slider."""
    rows = 2 if story.truth is not None else 1
    wide = {"type": "scene", "colspan": 3}
    specs: list[Any] = [[wide, None, None, wide, None, None]]
    judged = "yaw" if story.axes == "xy" else "rotation"
    turn = f"{judged} error (deg)"
    if story.truth is not None and story.truth[0] is None:
        turn = f"{judged} (deg): no truth"
    titles = ["in space", _close_title(story)]
    if rows == 2:
        specs.append([{"colspan": 2}, None] * 3)
        titles += [f"position error {story.axes} (m)", turn, "NEES"]
    shown: Any = make_subplots(
        rows,
        6,
        specs=specs,
        subplot_titles=titles,
        row_heights=[0.66, 0.34][:rows],
        horizontal_spacing=0.05,
        vertical_spacing=0.07,
    )
    moments = _thinned(len(story.times), _MOMENTS)
    _add_still(shown, story)
    if rows == 2:
        _add_curves(shown, story)
    tops = chart_limits(story) if rows == 2 else []
    count = len(shown.data)
    first = _moving(story, int(moments[0]), tops)
    for trace, (row, column) in first:
        shown.add_trace(trace, row=row, col=column)
    which = list(range(count, count + len(first)))
    apart = np.ptp(story.times) / max(len(moments) - 1, 1)
    places = max(0, -math.floor(math.log10(max(apart, 1e-9))))
    labels = [f"{story.times[k]:.{places}f}" for k in moments]
    shown.frames = [
        go.Frame(
            name=label,
            traces=which,
            data=[_change(trace) for trace, _ in _moving(story, int(k), tops)],
        )
        for k, label in zip(moments, labels, strict=True)
    ]
    reach = _reach(story)
    hidden = {"visible": False, "range": [-reach, reach]}
    shown.update_layout(
        height=880 if rows == 2 else 640,
        margin={"l": 50, "r": 10, "t": 60, "b": 20},
        template="plotly_white",
        scene=_world(story),
        scene2={
            "aspectmode": "cube",
            "camera": {"eye": {"x": 0.65, "y": -1.1, "z": 0.6}},
            "xaxis": hidden,
            "yaxis": hidden,
            "zaxis": hidden,
        },
        legend={"orientation": "h", "x": 0, "y": 1.05, "yanchor": "bottom"},
        sliders=[_slider(labels)],
        updatemenus=[_play()],
    )
    if rows == 2:
        shown.update_xaxes(title_text="time since the start (s)", title_standoff=4)
        for column, (low, high) in zip((1, 3), tops, strict=False):
            shown.update_yaxes(range=[low, high], row=2, col=column)
        shown.update_yaxes(
            type="log", range=np.log10(tops[2]).tolist(), **log_ticks(*tops[2]), row=2, col=5
        )
    return shown


def _thinned(count: int, most: int) -> np.ndarray:
    """Return at most this many indices of epochs, evenly spaced, with first and last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


class _Curves:
    """Thin arrays of K epochs out for curves, with a break at each gap without measurements."""

    def __init__(self, times: FloatArray) -> None:
        self._points = _thinned(len(times), _POINTS)
        self._breaks = np.searchsorted(self._points, gaps_of(times), side="right")

    def of(self, values: FloatArray) -> FloatArray:
        """Return values (K, ...) at the points of a curve; NaN at a break."""
        return np.insert(np.asarray(values[self._points], float), self._breaks, np.nan, axis=0)

    def under(self, times: FloatArray, values: FloatArray) -> tuple[list[Any], list[Any]]:
        """Return x and y of the areas below values (K,), a closed one between two breaks.

        A fill to zero would bridge the breaks.
        """
        x, y = [], []
        for at in np.split(self._points, self._breaks):
            if len(at):
                x.append(np.concatenate([times[at], times[at[[-1, 0]]], [np.nan]]))
                y.append(np.concatenate([values[at], [0.0, 0.0, np.nan]]))
        return solids.numbers(np.concatenate(x), 6), solids.numbers(np.concatenate(y))


# --- static part -------------------------------------------------------------------------------


def _add_still(shown: go.Figure, story: Story) -> None:
    shown.add_scatter3d(
        **solids.xyz(story.anchors),
        mode="markers+text",
        name="anchors",
        text=list(story.names),
        textposition="top center",
        textfont={"size": 10},
        hovertemplate="anchor %{text}<br>x %{x:.2f}, y %{y:.2f}, z %{z:.2f} m<extra></extra>",
        marker={"size": 5, "color": ANCHOR, "symbol": "diamond"},
        row=1,
        col=1,
    )
    curves = _Curves(story.times)
    if story.truth is not None:
        _, places, known = story.truth
        path = curves.of(np.where(known[:, None], places, np.nan))
        shown.add_trace(_wire(path, "#868e96", "true path", 5, showlegend=True), row=1, col=1)
    for name, belief in story.beliefs.items():
        style: dict[str, Any] = {"showlegend": True, "legendgroup": name}
        path = _wire(curves.of(belief.translation), belief.colour, name, 2, **style)
        shown.add_trace(path, row=1, col=1)


def _add_curves(shown: go.Figure, story: Story) -> None:
    curves = _Curves(story.times)
    times = solids.numbers(curves.of(story.times), 6)
    freedom = freedom_of(story)
    low, high = nees_interval(dof=freedom)
    for name, belief in story.beliefs.items():
        found = errors_of(story, belief)
        style: dict[str, Any] = {
            "mode": "lines",
            "legendgroup": name,
            "showlegend": False,
            "row": 2,
        }
        for column, std in ((1, found.position_std_m), (3, found.rotation_std_deg)):
            x, y = curves.under(story.times, 3 * std)
            shown.add_scatter(
                x=x,
                y=y,
                fill="toself",
                fillcolor=_faint(belief.colour),
                line={"width": 0},
                name="3 sigma",
                hoverinfo="skip",
                col=column,
                **style,
            )
        line = {"color": belief.colour, "width": 1.5}
        for column, values in ((1, found.position_m), (3, found.rotation_deg), (5, found.nees)):
            curve = solids.numbers(curves.of(values))
            shown.add_scatter(x=times, y=curve, name=name, line=line, col=column, **style)
    # Without this option plotly looks for two axes in the traces of 3-D scenes, too.
    where: dict[str, Any] = {"row": 2, "col": 5, "exclude_empty_subplots": False}
    grey = "#868e96"
    shown.add_hrect(low, high, line_width=0, fillcolor=grey, opacity=0.2, **where)
    shown.add_hline(freedom, line={"color": grey, "width": 1, "dash": "dot"}, **where)


def _faint(colour: str) -> str:
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.16)"


# --- moving part -------------------------------------------------------------------------------


def _moving(
    story: Story, k: int, tops: list[tuple[float, float]]
) -> list[tuple[Any, tuple[int, int]]]:
    """Return traces of epoch k and their positions: always the same ones in the same order."""
    known = story.truth is not None and bool(story.truth[2][k])
    first = next(iter(story.beliefs.values()))
    rotation, place = first.rotation[k], first.translation[k]
    if known:
        assert story.truth is not None
        place = story.truth[1][k]
        rotation = rotation if story.truth[0] is None else story.truth[0][k]
    body = story.tags @ rotation.T
    traces: list[tuple[Any, tuple[int, int]]] = [
        (
            go.Scatter3d(
                **solids.xyz(place[None]),
                mode="markers",
                name="body",
                hoverinfo="skip",
                marker={"size": 5, "color": INK},
                showlegend=False,
            ),
            (1, 1),
        )
    ]
    edges = body_edges(story.tags)
    if story.truth is not None:
        shape = gapped(body[edges]) if known else np.full((1, 3), np.nan)
        traces.append((_wire(shape, INK, "true body", showlegend=True), (1, 4)))
    reach = 0.6 * float(np.linalg.norm(story.tags, axis=-1).max())
    for axis, colour in zip(rotation.T, AXES, strict=True):
        line = np.stack([np.zeros(3), reach * axis])
        traces.append((_wire(line, colour, "axis", width=5), (1, 4)))
    factor = enlargement(story)
    for name, belief in story.beliefs.items():
        off = factor * (belief.translation[k] - place)
        turn = factor * rotations.error(belief.rotation[k], rotation)
        ghost = off + body @ rotations.exp(turn).T
        traces.append((_wire(gapped(ghost[edges]), belief.colour, name, legendgroup=name), (1, 4)))
        region = solids.ellipsoid(off, factor**2 * belief.covariance[k, 3:, 3:])
        traces.append(
            (
                go.Mesh3d(
                    **region,
                    **solids.net(),
                    color=belief.colour,
                    opacity=0.25,
                    name=name,
                    legendgroup=name,
                    showlegend=False,
                    hoverinfo="skip",
                ),
                (1, 4),
            )
        )
    for column, limits in zip((1, 3, 5), tops, strict=False):
        now = go.Scatter(
            x=[float(story.times[k])] * 2,
            y=list(limits),
            mode="lines",
            line={"color": INK, "width": 1},
            hoverinfo="skip",
            showlegend=False,
        )
        traces.append((now, (2, column)))
    return traces


def _wire(points: FloatArray, colour: str, name: str, width: float = 4, **style: Any) -> Any:
    style = {"showlegend": False, **style}
    return go.Scatter3d(
        **solids.xyz(points),
        mode="lines",
        name=name,
        hoverinfo="skip",
        line={"color": colour, "width": width},
        **style,
    )


def _change(trace: Any) -> Any:
    """Return only the changes of a trace."""
    data = {key: trace[key] for key in ("x", "y", "z") if key in trace}
    return type(trace)(**data)


def _close_title(story: Story) -> str:
    factor = enlargement(story)
    scale = "to scale" if factor == 1 else f"enlarged x {factor:g}"
    centre = "true place" if story.truth is not None else "estimate"
    return f"about the {centre}: 95 % regions, errors {scale}"


def _world(story: Story) -> dict[str, Any]:
    """Return axes with equal scales around all objects; flat scenes get some height."""
    points = [story.anchors, *(belief.translation for belief in story.beliefs.values())]
    if story.truth is not None:
        points.append(story.truth[1][story.truth[2]])
    everywhere = np.concatenate(points)
    # Estimates of the first epochs may be anywhere.
    low, high = np.quantile(everywhere, [0.002, 0.998], axis=0)
    low, high = (
        np.minimum(low, story.anchors.min(axis=0)),
        np.maximum(high, story.anchors.max(axis=0)),
    )
    size = 1.08 * np.maximum(high - low, 0.2 * (high - low).max())
    middle = 0.5 * (low + high)
    scene: dict[str, Any] = {
        f"{name}axis": {"title": {"text": f"{name} (m)"}, "range": [at - 0.5 * s, at + 0.5 * s]}
        for name, at, s in zip("xyz", middle.tolist(), size.tolist(), strict=True)
    }
    shape = size / size.max()
    # Flat worlds have room to be shown larger.
    ratio = dict(zip("xyz", (shape / np.prod(shape) ** (1 / 6)).tolist(), strict=True))
    # From far enough that the labels of the z axis fit.
    camera = {"eye": {"x": 1.0, "y": -1.7, "z": 1.0}, "center": {"x": -0.08, "y": 0, "z": -0.1}}
    return {"aspectmode": "manual", "aspectratio": ratio, "camera": camera, **scene}


def _reach(story: Story) -> float:
    return 1.25 * float(np.linalg.norm(story.tags, axis=-1).max())


def _slider(labels: list[str]) -> dict[str, Any]:
    options = {
        "mode": "immediate",
        "frame": {"duration": 0, "redraw": True},
        "transition": {"duration": 0},
    }
    steps = [{"label": label, "method": "animate", "args": [[label], options]} for label in labels]
    return {
        "steps": steps,
        "x": 0.12,
        "len": 0.88,
        "y": -0.02,
        "pad": {"t": 30},
        "currentvalue": {"prefix": "time ", "suffix": " s", "xanchor": "left"},
        "transition": {"duration": 0},
    }


def _play() -> dict[str, Any]:
    play = {
        "fromcurrent": True,
        "frame": {"duration": 60, "redraw": True},
        "transition": {"duration": 0},
    }
    stop = {"mode": "immediate", "frame": {"duration": 0, "redraw": False}}
    return {
        "type": "buttons",
        "direction": "right",
        "x": 0,
        "xanchor": "left",
        "y": -0.02,
        "yanchor": "top",
        "pad": {"t": 46},
        "showactive": False,
        "buttons": [
            {"label": "play", "method": "animate", "args": [None, play]},
            {"label": "pause", "method": "animate", "args": [[None], stop]},
        ],
    }


def anchors_table(story: Story) -> str:
    """Return a table of the anchor positions."""
    rows = [
        [str(name), *map(float, place)]
        for name, place in zip(story.names, story.anchors, strict=True)
    ]
    return page.table("anchors", ["anchor", "x (m)", "y (m)", "z (m)"], rows)


def log_ticks(low: float, high: float) -> dict[str, Any]:
    """Return 1, 2 and 5 of every decade, more on a short axis; plotly's labels are bare digits."""
    digits = (1, 2, 5) if high > 5 * low else (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8)
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    marks = [float(f"{digit}e{decade}") for decade in decades for digit in digits]
    return {"tickvals": marks, "ticktext": [f"{mark:g}" for mark in marks]}
