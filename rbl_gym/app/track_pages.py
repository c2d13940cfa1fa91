"""The pages of `rbl-gym demo` and `rbl-gym replay`: a track in 3-D, charts, tables."""

from __future__ import annotations

from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots
from scipy.stats import chi2

from rbl_gym.app import page, track_html
from rbl_gym.app.camsap2013 import Example
from rbl_gym.app.figures import COLOURS
from rbl_gym.app.replay import Settings, Track, truth_of
from rbl_gym.app.reports import CAMSAP_COLUMNS
from rbl_gym.app.track_html import Beliefs, Story
from rbl_gym.recordings import Recording

_LEGEND = (
    "Drag to turn, wheel to zoom; play, or move the slider. Shaded: three sigma of the belief "
    "(errors and sigma of all axes together). NEES: the band holds 95 % of the epochs of an "
    "honest filter, the dotted line is their mean."
)


def demo(result: dict[str, Any], example: Example) -> str:
    """The tracking paper's experiment: one trial to look at, and all of them in figures."""
    scene, episode = example.world.scene, example.world.episode
    beliefs = {
        name: Beliefs(
            np.array([belief.rotation[0] for belief in steps]),
            np.array([belief.translation[0] for belief in steps]),
            np.array([belief.covariance[0] for belief in steps]),
            COLOURS[name],
        )
        for name, steps in example.beliefs.items()
    }  # fmt: skip
    count = episode.rotation.shape[1]
    story = Story(
        scene.dt * np.arange(1, count + 1), episode.anchors[0],
        [str(k + 1) for k in range(scene.n_anchors)], np.asarray(scene.tags),
        (episode.rotation[0], episode.translation[0], np.ones(count, dtype=np.bool_)), beliefs,
    )  # fmt: skip
    reading = next(iter(result["readings"]))
    tables = []
    for name, data in result["readings"].items():
        headings = ["filter", *(column[0] for column in CAMSAP_COLUMNS)]
        rows = [[label, *(form.format(row[key]) for _, key, form in CAMSAP_COLUMNS)]
                for label, row in data["filters"].items()]  # fmt: skip
        tables.append(page.table(f"turn noise {name}/s, {result['trials']} trials", headings, rows))
        claims = [
            [claim["statement"], claim["holds"], claim["figures"]] for claim in data["claims"]
        ]
        tables.append(page.table(f"claims at {name}/s", ["claim", "holds", "figures"], claims))
    parts = [
        page.note(f"One trial at turn noise {reading}/s. {_LEGEND}"),
        page.plot(track_html.figure(story), "track"),
        "<h2>All trials</h2>",
        page.plot(_curves(result), "curves", first=False),
        page.note("Ratios are to the posterior Cramer-Rao bound, averaged over the steps; reward "
                  "= -log b, b the expected RMS error of the tags in metres; NEES of an honest "
                  "filter is 6."),
        *tables,
    ]  # fmt: skip
    return page.document("Tracking a rigid body: five filters and the bound", parts)


def _curves(result: dict[str, Any]) -> go.Figure:
    """RMSE and mean NEES per step of all trials, a row for each reading."""
    readings = result["readings"]
    charts = (("rotation_rmse", "rotation RMSE (Frobenius)"),
              ("translation_rmse_m", "translation RMSE (m)"), ("nees", "mean NEES"))  # fmt: skip
    titles = [f"{title}, {name}/s" for name in readings for _, title in charts]
    shown = make_subplots(len(readings), 3, subplot_titles=titles, horizontal_spacing=0.07,
                          vertical_spacing=0.13)  # fmt: skip
    trials = result["trials"]
    low, high = chi2.ppf([0.025, 0.975], 6 * trials) / trials
    for row, data in enumerate(readings.values(), 1):
        for column, (key, _) in enumerate(charts, 1):
            lines = {name: filter["per_step"][key] for name, filter in data["filters"].items()}
            steps = list(range(1, len(next(iter(lines.values()))) + 1))
            for name, values in lines.items():
                shown.add_trace(
                    go.Scatter(x=steps, y=values, name=name, legendgroup=name,
                               showlegend=row == column == 1,
                               line={"color": COLOURS[name], "width": 2,
                                     "dash": "dash" if name == "KF-ortho" else "solid"}),
                    row=row, col=column,
                )  # fmt: skip
            if key != "nees":
                drawn = [*data["bound"][key], *(value for line in lines.values() for value in line)]
                shown.update_yaxes(
                    type="log", **track_html.log_ticks(min(drawn), max(drawn)), row=row, col=column
                )
                shown.add_trace(
                    go.Scatter(x=steps, y=data["bound"][key], name="posterior CRB", mode="markers",
                               legendgroup="bound", showlegend=row == column == 1,
                               marker={"color": "#222222", "size": 5}),
                    row=row, col=column,
                )  # fmt: skip
        shown.update_xaxes(range=[0.5, steps[-1] + 0.5], row=row)
        shown.add_hrect(low, high, row=row, col=3, line_width=0, fillcolor="#868e96", opacity=0.25)  # pyright: ignore[reportArgumentType]
    shown.update_xaxes(title_text="step", title_standoff=4)
    shown.update_annotations(font_size=13)
    legend = {"orientation": "h", "x": 0, "y": 1.06, "yanchor": "bottom"}
    shown.update_layout(height=320 * len(readings) + 40, template="plotly_white", legend=legend,
                        margin={"l": 50, "r": 10, "t": 60, "b": 40})  # fmt: skip
    return shown


def replay(recording: Recording, track: Track, result: dict[str, Any], settings: Settings) -> str:
    """A recording: the track, its errors where truth exists, the figures of the run."""
    truth = truth_of(recording, track, settings)
    times = track.times - track.times[0]
    beliefs = Beliefs(*track[1:], COLOURS["iterated EKF"])
    story = Story(
        times, recording.anchors, recording.anchor_ids, recording.tags, truth,
        {settings.filter: beliefs}, "xy" if settings.planar else "xyz",
    )  # fmt: skip
    parts = [page.note(_LEGEND), page.plot(track_html.figure(story), "track")]
    if truth is not None:
        rows = [
            [f"{name} {result['position_axes']} (m)" if unit == "m" else f"{name} (deg)",
             *(result[f"{name}_{what}_{unit}"] for what in ("rmse", "median", "p95"))]
            for name, unit in (("position", "m"), ("yaw", "deg"), ("rotation", "deg"))
        ]  # fmt: skip
        parts.append(page.table("errors", ["error", "RMSE", "median", "p95"], rows))
        parts.append(page.note(f"NEES per degree of freedom {result['anees']:.2f} (1: honest)."))
    parts.append(track_html.anchors_table(story))
    used = [[name.replace("_", " "), value] for name, value in result["settings"].items()]
    parts.append(page.table("settings", ["setting", "value"], used))
    title = f"{result['epochs']} epochs, {result['links']} ranges, filter {settings.filter}"
    return page.document(f"A recording replayed: {title}", parts)
