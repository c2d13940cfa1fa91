"""The HTML page of `rbl-gym bench`: the effect of stress on every filter, and all rows."""

from __future__ import annotations

from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from rbl_gym.app import bench_report, page
from rbl_gym.studies.bench.leaderboard import is_recording

_COLUMNS = 4
# Ratios to the bound above this have one colour: the filter is lost.
_LOST_RATIO = 30.0
_HEADINGS = (
    "scene",
    "condition",
    "filter",
    "position (m)",
    "rotation (deg)",
    "tags (m)",
    "median (m)",
    "p95 (m)",
    "x bound",
    "ANEES",
    "verdict",
    "lost (%)",
    "flipped (%)",
    "triggered (%)",
    "us / step",
    "remark",
)


def bench(result: dict[str, Any]) -> str:
    """Return the page of a result of `leaderboard.summary`."""
    rows = [
        row | {"microseconds_per_step": microseconds}
        for row, microseconds in zip(result["rows"], result["microseconds_per_step"], strict=True)
    ]
    first = rows[0]
    # A recording has no bound, hence no colours.
    simulated = [row for row in rows if not is_recording(row["spec"])]
    conditions = "; ".join(f"{name}: {text}" for name, text in result["conditions"].items())
    return page.document(
        "Which filter? The leaderboard",
        [
            page.note(
                f"{_trials(rows)} in each row, seed {first['seed']}. All filters of a scene have "
                "the same motion, prior and noise. Colours and numbers of the maps: RMS tag "
                "error over the posterior Cramer-Rao bound. 1 is the best possible value; from "
                "30 on, a filter is lost."
            ),
            *([page.plot(_maps(simulated), "maps")] if simulated else []),
            page.note(f"Conditions. {conditions}."),
            page.table(f"{len(rows)} rows", _HEADINGS, [_cells(row) for row in rows]),
            page.note(
                "Root mean squares over trials and epochs; median and 95th percentile of the tag "
                "error. ANEES per degree of freedom: 1 is consistent, more is optimistic. Times "
                "are those of the machine that ran the benchmark."
            ),
        ],
    )


def _trials(rows: list[dict[str, Any]]) -> str:
    """Describe the data of the rows: trials of scenes, recordings, or both."""
    return " or ".join(dict.fromkeys(bench_report.trials(row) for row in rows))


def _maps(rows: list[dict[str, Any]]) -> go.Figure:
    """Return a map per scene: filters by conditions, coloured by the ratio to the bound."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    filters = list(dict.fromkeys(row["filter"] for row in rows))[::-1]
    conditions = list(dict.fromkeys(row["condition"] for row in rows))
    columns = min(_COLUMNS, len(scenes))
    lines = -(-len(scenes) // columns)
    shown = make_subplots(
        lines,
        columns,
        subplot_titles=scenes,
        shared_yaxes=True,
        horizontal_spacing=0.02,
        vertical_spacing=0.36 / lines,
    )
    for k, scene in enumerate(scenes):
        ratio = np.full((len(filters), len(conditions)), np.nan)
        for row in rows:
            if row["scene"] == scene and "tags_m" in row:
                at = filters.index(row["filter"]), conditions.index(row["condition"])
                ratio[at] = row["tags_m"].get("to_bound") or np.nan
        text = [["" if np.isnan(r) else page.digits(r, 3) for r in line] for line in ratio]
        shown.add_heatmap(
            z=np.log10(ratio),
            x=conditions,
            y=filters,
            text=text,
            texttemplate="%{text}",
            coloraxis="coloraxis",
            hoverongaps=False,
            hovertemplate="%{y}, %{x}: %{text} x bound<extra>" + scene + "</extra>",
            row=1 + k // columns,
            col=1 + k % columns,
        )
    ticks = [1, 2, 5, 10, _LOST_RATIO]
    shown.update_layout(
        height=90 + lines * (110 + 30 * len(filters)),
        margin={"l": 10, "r": 10, "t": 50, "b": 10},
        template="plotly_white",
        font={"size": 11},
        coloraxis={
            "colorscale": [[0, "#e8f4ef"], [0.3, "#f6e3a1"], [0.65, "#e08a4b"], [1, "#9c2f3c"]],
            "cmin": 0,
            "cmax": float(np.log10(_LOST_RATIO)),
            "colorbar": {
                "title": "x bound",
                "tickvals": np.log10(ticks).tolist(),
                "ticktext": [f"{tick:g}" for tick in ticks],
                "thickness": 12,
            },
        },
    )
    return shown


def _cells(row: dict[str, Any]) -> list[Any]:
    """Return a row of the table; "-" with a remark if a filter could not run."""
    head = [row["scene"], row["condition"], row["filter"]]
    remark = row["message"] or (
        f"rank {row['rank']} of {row['states']}" if row["rank"] != row["states"] else None
    )
    if "tags_m" not in row:
        return [*head, *[None] * (len(_HEADINGS) - 4), f"{row['status']}: {remark}"]
    tags = row["tags_m"]
    percent = [
        None if row.get(key) is None else 100 * row[key]
        for key in ("lost", "flipped", "trigger_rate")
    ]
    figures = [
        row["position_m"]["rmse"],
        row["rotation_deg"]["rmse"],
        tags["rmse"],
        tags["median"],
        tags["p95"],
        tags.get("to_bound"),
        row["anees"],
    ]
    shown = [None if figure is None else page.digits(figure, 4) for figure in figures]
    return [*head, *shown, row["verdict"], *percent, row["microseconds_per_step"], remark]
