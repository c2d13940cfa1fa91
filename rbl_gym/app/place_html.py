"""A placement as one HTML file: answer, plan with maps, tables, 3-D scene.

The file includes plotly's script (extra ``viz``) and needs no network.
"""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go

from rbl_gym.app import page, place_answer, solids
from rbl_gym.app import place_shapes as shapes
from rbl_gym.app.place_assets import SCRIPT, STYLE
from rbl_gym.app.place_figures import anchor_names
from rbl_gym.app.place_pdf import mounting_rows
from rbl_gym.app.place_report import notes, tables
from rbl_gym.app.place_svg import answer_part, plan_part
from rbl_gym.geometry.mounts import Mounts
from rbl_gym.geometry.polygons import prism_edges
from rbl_gym.geometry.regions import Shell
from rbl_gym.rendering.drawing import box_edges
from rbl_gym.studies.placing.answer import Placed


def write_place(placed: Placed, path: str) -> None:
    """Write the page; create its folder."""
    result = placed.result
    headings, *rows = mounting_rows(placed)
    parts = [
        f"<style>{STYLE}</style>",
        f"<p>{place_answer.headline(result)}</p>",
        *(page.note(text) for text in place_answer.warnings(result)),
        answer_part(result),
        plan_part(placed),
        page.table("mounting list", headings, rows),
        *(page.table(*table) for table in tables(result)),
        "<h2>the scene in 3-D</h2>",
        f'<div class="scene">{page.plot(place_scene(placed), "scene")}</div>',
        *(page.note(text) for text in notes(result)),
        f"<script>{SCRIPT}</script>",
    ]
    page.write(page.document(f"Anchors for {result['scene']}", parts), path)


def place_scene(placed: Placed) -> go.Figure:
    """Return anchors, obstacles, zones, and a map at mid-height of each zone, in 3-D."""
    problem, anchors = placed.problem, placed.design.anchors
    shown = go.Figure()
    quantity = shapes.quantities(problem)[0]
    maps = shapes.maps_of(placed)
    layers = shapes.layers(problem, maps, quantity.field)
    low, high = shapes.colour_range(layers, None)
    for plane, layer in zip(maps, layers, strict=True):
        shown.add_surface(
            x=plane.columns,
            y=plane.rows,
            z=np.full(layer.values.shape, plane.at).tolist(),
            surfacecolor=solids.numbers(np.where(layer.free, layer.values, np.nan)),
            colorscale="Viridis",
            reversescale=True,
            opacity=0.9,
            cmin=low,
            cmax=high,
            showscale=plane is maps[0],
            showlegend=False,
            colorbar={
                "title": {"text": f"{quantity.name} ({quantity.unit})", "side": "top"},
                "orientation": "h",
                "len": 0.7,
                "thickness": 12,
                "y": -0.02,
            },
            hovertemplate="x %{x:.2f}, y %{y:.2f}, z %{z:.2f} m<br>%{surfacecolor:.4g}"
            f"<extra>{layer.zone.name}</extra>",
        )
    for index, zone in enumerate(problem.zones):
        style = {"color": "#222222", "width": 3, "dash": "dash"}
        edges = prism_edges(zone.polygon, zone.low_m, zone.high_m)
        shown.add_trace(
            solids.lines(edges, name="zones", legendgroup="zones", showlegend=not index, line=style)
        )
    if not isinstance(problem.mounts, Mounts | Shell):
        edges = box_edges(*problem.mounts.bounds())
        style = {"color": "#8a8f94", "width": 3}
        shown.add_trace(solids.lines(edges, name="where anchors may be mounted", line=style))
    blocks = shapes.solids(problem)
    if blocks:
        shown.add_trace(
            solids.prisms([(s.corners, s.low_m, s.high_m) for s in blocks], name="obstacles")
        )
    shown.add_scatter3d(
        **solids.xyz(anchors),
        mode="markers+text",
        name="anchors",
        text=anchor_names(placed),
        textposition="top center",
        marker={"size": 5, "color": "#111111", "symbol": "diamond"},
        hovertemplate="anchor %{text}<br>x %{x:.3f}, y %{y:.3f}, z %{z:.3f} m<extra></extra>",
    )
    shown.update_layout(
        margin={"l": 0, "r": 0, "t": 10, "b": 0},
        scene={
            "aspectmode": "data",
            "xaxis_title": "x (m)",
            "yaxis_title": "y (m)",
            "zaxis_title": "z (m)",
            "camera": {"eye": {"x": -1.0, "y": -1.9, "z": 1.6}},
        },
        legend={"orientation": "h", "x": 0.0, "y": 1.0},
    )
    return shown
