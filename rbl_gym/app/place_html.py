"""A placement as one HTML file: the scene in 3-D with its map of accuracy, and the tables.

The file carries plotly's script (extra ``viz``) and needs no network.
"""

from __future__ import annotations

import html
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go

from rbl_gym.app.place import Map, Placed, level_maps
from rbl_gym.app.place_report import Rows, notes, tables
from rbl_gym.checks import FloatArray
from rbl_gym.regions import Shell

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1100px; margin: 2em auto;
       padding: 0 1em; }
h1 { font-size: 1.5em; margin-bottom: 0; } h2 { font-size: 1.05em; margin: 1.6em 0 .4em; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9em; font-variant-numeric: tabular-nums; }
th, td { padding: .25em .8em; text-align: right; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child { text-align: left; } th { background: #f3f5f6; }
p.note { color: #555; font-size: .9em; margin: .4em 0; }
"""
# The twelve edges of a box as one line: corners by index, None between strokes.
_EDGES = (0, 1, 3, 2, 0, 4, 5, 7, 6, 4, None, 1, 5, None, 2, 6, None, 3, 7)
# The twelve triangles of a box, by corner.
_TRIANGLES = ((0, 0, 4, 4, 0, 0, 2, 2, 0, 0, 1, 1), (1, 3, 5, 7, 1, 5, 3, 7, 2, 6, 3, 7),
              (3, 2, 7, 6, 5, 4, 7, 6, 6, 4, 7, 5))  # fmt: skip


def write(placed: Placed, path: str) -> None:
    """Write the page, making its folder."""
    result = placed.result
    figure = scene(placed)
    title = html.escape(f"{result['scene']}: {result['n_anchors']} anchors")
    plot = figure.to_html(full_html=False, include_plotlyjs=True, div_id="scene")
    parts = [
        "<!DOCTYPE html>", '<html lang="en"><head><meta charset="utf-8">',
        f"<title>{title}</title><style>{_STYLE}</style></head><body>", f"<h1>{title}</h1>", plot,
        *(_table(rows) for rows in tables(result)),
        *(f'<p class="note">{html.escape(note)}</p>' for note in notes(result)),
        "</body></html>\n",
    ]  # fmt: skip
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text("\n".join(parts), encoding="utf-8")


def _table(rows: Rows) -> str:
    head = "".join(f"<th>{html.escape(text)}</th>" for text in rows.headings)
    body = "\n".join(
        "<tr>" + "".join(f"<td>{html.escape(text)}</td>" for text in row) + "</tr>"
        for row in rows.rows
    )
    return (
        f'<h2>{html.escape(rows.title)}</h2><div class="wide"><table><thead><tr>{head}</tr>'
        f"</thead><tbody>\n{body}\n</tbody></table></div>"
    )


def scene(placed: Placed) -> go.Figure:
    """Anchors, obstacles, region and map; a slider for its height, buttons for what it shows."""
    problem, anchors = placed.problem, placed.design.anchors
    maps = level_maps(problem, anchors)
    middle = len(maps) // 2
    low, high = problem.corners()
    shown = go.Figure()
    for key, label, on in (("position", "position, 1 sigma (m)", True),
                           ("rotation", "orientation, 1 sigma (deg)", False)):  # fmt: skip
        values = np.concatenate([getattr(level, key).ravel() for level in maps])
        shown.add_surface(
            x=maps[middle].columns, y=maps[middle].rows, z=_height(maps[middle]),
            surfacecolor=_numbers(getattr(maps[middle], key)), name=key, visible=on,
            colorscale="Viridis", reversescale=True, opacity=0.9, showlegend=False,
            cmin=float(np.nanmin(values)), cmax=float(np.nanquantile(values, 0.99)),
            colorbar={"title": {"text": label, "side": "right"}, "len": 0.7},
            hovertemplate="x %{x:.2f}, y %{y:.2f}, z %{z:.2f} m<br>%{surfacecolor:.4g}"
            f"<extra>{key}</extra>",
        )  # fmt: skip
    _add_box(shown, low, high, "work region", "#222222", dash="dash")
    region = problem.task.scene.anchor_region
    if not isinstance(region, Shell):
        _add_box(shown, *region.bounds(), "where anchors may stand", "#8a8f94", dash="solid")
    for index, box in enumerate(problem.context.racks):
        _add_solid(shown, box[:3] - box[3:], box[:3] + box[3:], first=index == 0)
    shown.add_scatter3d(
        x=anchors[:, 0], y=anchors[:, 1], z=anchors[:, 2], mode="markers+text", name="anchors",
        text=[str(index + 1) for index in range(len(anchors))], textposition="top center",
        marker={"size": 6, "color": "#d1495b", "symbol": "diamond"},
        customdata=[[anchor["sees"]] for anchor in placed.result["anchors"]],
        hovertemplate="anchor %{text}<br>x %{x:.3f}, y %{y:.3f}, z %{z:.3f} m<br>"
        "sees %{customdata[0]:.0%} of the region<extra></extra>",
    )  # fmt: skip
    others = sum(1 for _ in shown.select_traces()) - 2
    shown.update_layout(
        height=720, margin={"l": 0, "r": 0, "t": 40, "b": 30},
        scene={"domain": {"y": [0.1, 1.0]}, "aspectmode": "data", "xaxis_title": "x (m)",
               "yaxis_title": "y (m)", "zaxis_title": "z (m)",
               "camera": {"eye": {"x": -0.9, "y": -1.8, "z": 1.3}}},
        legend={"orientation": "h", "x": 0.25, "y": 1.0},
        updatemenus=[_buttons(others)],
        sliders=[_slider(maps, middle)] if len(maps) > 1 else [],
    )  # fmt: skip
    return shown


def _buttons(others: int) -> dict[str, Any]:
    rest = [True] * others
    return {
        "type": "buttons", "direction": "right", "x": 0.0, "y": 1.02, "xanchor": "left",
        "yanchor": "top",
        "buttons": [
            {"label": label, "method": "restyle", "args": [{"visible": [*which, *rest]}]}
            for label, which in (("position", (True, False)), ("orientation", (False, True)))
        ],
    }  # fmt: skip


def _slider(maps: list[Map], active: int) -> dict[str, Any]:
    steps = [
        {
            "label": f"{level.at:.3g}",
            "method": "restyle",
            "args": [
                {"z": [_height(level)] * 2,
                 "surfacecolor": [_numbers(level.position), _numbers(level.rotation)]},
                [0, 1],
            ],
        }
        for level in maps
    ]  # fmt: skip
    return {
        "active": active, "steps": steps, "len": 0.6, "x": 0.2, "y": 0.1,
        "currentvalue": {"prefix": "height of the map z = ", "suffix": " m"},
    }  # fmt: skip


def _height(level: Map) -> list[list[float]]:
    return np.full(level.position.shape, level.at).tolist()


def _numbers(values: FloatArray) -> list[list[float | None]]:
    """To five digits, None where blocked: pages stay small, and NaN is no JSON."""
    return [[None if np.isnan(x) else float(f"{x:.5g}") for x in row] for row in values]


def _corners(low: FloatArray, high: FloatArray) -> FloatArray:
    """The eight corners (8, 3), z fastest."""
    pairs = np.stack([low, high])
    return np.array([[pairs[i, 0], pairs[j, 1], pairs[k, 2]]
                     for i in (0, 1) for j in (0, 1) for k in (0, 1)])  # fmt: skip


def _add_box(
    shown: go.Figure, low: FloatArray, high: FloatArray, name: str, colour: str, dash: str
) -> None:
    corners = _corners(low, high)
    line = [[None] * 3 if index is None else corners[index].tolist() for index in _EDGES]
    x, y, z = zip(*line, strict=True)
    shown.add_scatter3d(x=x, y=y, z=z, mode="lines", name=name, hoverinfo="skip",
                        line={"color": colour, "width": 3, "dash": dash})  # fmt: skip


def _add_solid(shown: go.Figure, low: FloatArray, high: FloatArray, first: bool) -> None:
    x, y, z = _corners(low, high).T.tolist()
    i, j, k = _TRIANGLES
    shown.add_mesh3d(x=x, y=y, z=z, i=i, j=j, k=k, color="#6c757d", opacity=0.55, flatshading=True,
                     name="obstacles", legendgroup="obstacles", showlegend=first,
                     hoverinfo="skip")  # fmt: skip
