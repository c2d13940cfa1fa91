"""A placement as one HTML file: the scene in 3-D with its map of accuracy, and the tables.

The file carries plotly's script (extra ``viz``) and needs no network.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import plotly.graph_objects as go

from rbl_gym.app import page, solids
from rbl_gym.app.place_report import notes, tables
from rbl_gym.geometry.regions import Shell
from rbl_gym.studies.placing.accuracy import Map, level_maps
from rbl_gym.studies.placing.answer import Placed


def write_place(placed: Placed, path: str) -> None:
    """Write the page, making its folder."""
    result = placed.result
    title = f"{result['scene']}: {result['n_anchors']} anchors"
    parts = [
        page.plot(place_scene(placed), "scene"),
        *(page.table(*rows) for rows in tables(result)),
        *(page.note(text) for text in notes(result)),
    ]
    page.write(page.document(title, parts), path)


def place_scene(placed: Placed) -> go.Figure:
    """Anchors, obstacles, region and map; a slider for its height, buttons for what it shows."""
    problem, anchors = placed.problem, placed.design.anchors
    maps = level_maps(problem, anchors)
    middle = len(maps) // 2
    low, high = problem.corners()
    shown = go.Figure()
    for key, label, on in (
        ("position", "position, 1 sigma (m)", True),
        ("rotation", "orientation, 1 sigma (deg)", False),
    ):
        values = np.concatenate([getattr(level, key).ravel() for level in maps])
        shown.add_surface(
            x=maps[middle].columns,
            y=maps[middle].rows,
            z=_height(maps[middle]),
            surfacecolor=solids.numbers(getattr(maps[middle], key)),
            name=key,
            visible=on,
            colorscale="Viridis",
            reversescale=True,
            opacity=0.9,
            showlegend=False,
            cmin=float(np.nanmin(values)),
            cmax=float(np.nanquantile(values, 0.99)),
            colorbar={"title": {"text": label, "side": "right"}, "len": 0.7},
            hovertemplate="x %{x:.2f}, y %{y:.2f}, z %{z:.2f} m<br>%{surfacecolor:.4g}"
            f"<extra>{key}</extra>",
        )
    style = {"color": "#222222", "width": 3, "dash": "dash"}
    shown.add_trace(solids.box(low, high, name="work region", line=style))
    region = problem.mounts
    if not isinstance(region, Shell):
        style = {"color": "#8a8f94", "width": 3}
        shown.add_trace(solids.box(*region.bounds(), name="where anchors may stand", line=style))
    for index, box in enumerate(problem.obstacles.boxes):
        shown.add_trace(
            solids.solid(
                box[:3] - box[3:],
                box[:3] + box[3:],
                name="obstacles",
                legendgroup="obstacles",
                showlegend=index == 0,
            )
        )
    shown.add_scatter3d(
        x=anchors[:, 0],
        y=anchors[:, 1],
        z=anchors[:, 2],
        mode="markers+text",
        name="anchors",
        text=[str(index + 1) for index in range(len(anchors))],
        textposition="top center",
        marker={"size": 6, "color": "#d1495b", "symbol": "diamond"},
        customdata=[[anchor["sees"]] for anchor in placed.result["anchors"]],
        hovertemplate="anchor %{text}<br>x %{x:.3f}, y %{y:.3f}, z %{z:.3f} m<br>"
        "sees %{customdata[0]:.0%} of the region<extra></extra>",
    )
    others = sum(1 for _ in shown.select_traces()) - 2
    shown.update_layout(
        height=720,
        margin={"l": 0, "r": 0, "t": 40, "b": 30},
        scene={
            "domain": {"y": [0.1, 1.0]},
            "aspectmode": "data",
            "xaxis_title": "x (m)",
            "yaxis_title": "y (m)",
            "zaxis_title": "z (m)",
            "camera": {"eye": {"x": -0.9, "y": -1.8, "z": 1.3}},
        },
        legend={"orientation": "h", "x": 0.25, "y": 1.0},
        updatemenus=[_buttons(others)],
        sliders=[_slider(maps, middle)] if len(maps) > 1 else [],
    )
    return shown


def _buttons(others: int) -> dict[str, Any]:
    rest = [True] * others
    return {
        "type": "buttons",
        "direction": "right",
        "x": 0.0,
        "y": 1.02,
        "xanchor": "left",
        "yanchor": "top",
        "buttons": [
            {"label": label, "method": "restyle", "args": [{"visible": [*which, *rest]}]}
            for label, which in (("position", (True, False)), ("orientation", (False, True)))
        ],
    }


def _slider(maps: list[Map], active: int) -> dict[str, Any]:
    steps = [
        {
            "label": f"{level.at:.3g}",
            "method": "restyle",
            "args": [
                {
                    "z": [_height(level)] * 2,
                    "surfacecolor": [
                        solids.numbers(level.position),
                        solids.numbers(level.rotation),
                    ],
                },
                [0, 1],
            ],
        }
        for level in maps
    ]
    return {
        "active": active,
        "steps": steps,
        "len": 0.6,
        "x": 0.2,
        "y": 0.1,
        "currentvalue": {"prefix": "height of the map z = ", "suffix": " m"},
    }


def _height(level: Map) -> list[list[float]]:
    return np.full(level.position.shape, level.at).tolist()
