"""Pages of `rbl-gym demo` and `rbl-gym replay`: a track in 3-D, charts, tables."""

from __future__ import annotations

from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from rbl_gym.app import page, track_html
from rbl_gym.app.consistency import consistency_parts
from rbl_gym.app.figures import COLOURS
from rbl_gym.app.reports import CAMSAP_COLUMNS, compared, error_rows, turn_open
from rbl_gym.app.story import Beliefs, Story
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.epochs import nees_interval
from rbl_gym.studies.papers.camsap2013 import Example
from rbl_gym.studies.replay import Replayed, origin_of, truth_of

_LEGEND = (
    "Drag to turn, wheel to zoom; play, or move the slider. Shaded: three sigma of the belief "
    "(errors and sigma of all axes together). NEES: the band has 95 % of the epochs of a "
    "consistent filter, the dotted line is its mean."
)


def demo_page(result: dict[str, Any], example: Example) -> str:
    """Write the tracking paper's experiment: one trial, and statistics of all trials."""
    scene, episode = example.trials.scene, example.trials.episode
    beliefs = {
        name: Beliefs(*belief[:3], COLOURS[name]) for name, belief in example.beliefs.items()
    }
    count = episode.rotation.shape[1]
    story = Story(
        scene.dt * np.arange(1, count + 1),
        episode.anchors[0],
        [str(k + 1) for k in range(scene.n_anchors)],
        np.asarray(scene.tags),
        (episode.rotation[0], episode.translation[0], np.ones(count, dtype=np.bool_)),
        beliefs,
    )
    headings = ["filter", *(column[0] for column in CAMSAP_COLUMNS)]
    rows = [
        [label, *(form.format(row[key]) for _, key, form in CAMSAP_COLUMNS)]
        for label, row in result["filters"].items()
    ]
    claims = [
        [claim["source"], claim["statement"], claim["holds"], claim["figures"]]
        for claim in result["claims"]
    ]
    assumed = ", ".join(result["assumed"])
    parts = [
        page.note(f"One trial. {_LEGEND}"),
        page.plot(track_html.track_figure(story), "track"),
        "<h2>All trials</h2>",
        page.plot(_curves(result), "curves", first=False),
        page.note(
            "Ratios are to the posterior Cramer-Rao bound, averaged over the steps; reward = "
            "-log b, b the expected RMS error of the tags in metres. The NEES of a consistent "
            f"filter is 6. Assumed, as the paper does not print it: {assumed}."
        ),
        page.table(f"filters, {result['trials']} trials", headings, rows),
        page.table("claims", ["of", "claim", "holds", "figures"], claims),
    ]
    return page.document("Tracking a rigid body: five filters and the bound", parts)


def _curves(result: dict[str, Any]) -> go.Figure:
    """Return RMSE (Fig. 2), MAE (Fig. 3) and mean NEES per step of all trials."""
    charts = (
        ("rotation_rmse", "rotation RMSE (Frobenius)"),
        ("translation_rmse_m", "translation RMSE (m)"),
        ("mean_angular_error_deg", "mean angular error (deg)"),
        ("nees", "mean NEES"),
    )
    shown = make_subplots(
        2,
        2,
        subplot_titles=[title for _, title in charts],
        horizontal_spacing=0.08,
        vertical_spacing=0.13,
    )
    trials = result["trials"]
    low, high = nees_interval(trials)
    steps = list(range(1, len(result["bound"]["rotation_rmse"]) + 1))
    for k, (key, _) in enumerate(charts):
        row, column = divmod(k, 2)
        lines = {
            name: (filter["per_step"][key], COLOURS[name], "lines")
            for name, filter in result["filters"].items()
        }
        if key in result["bound"]:
            estimated = result["filters"]["KF"]["per_step"][f"estimated_{key}"]
            lines["estimated by KF"] = (estimated, "#868e96", "markers")
            lines["posterior CRB"] = (result["bound"][key], "#222222", "markers")
        for name, (values, colour, mode) in lines.items():
            dash = "dash" if name == "KF-ortho" else "solid"
            shown.add_scatter(
                x=steps,
                y=values,
                name=name,
                legendgroup=name,
                showlegend=k == 0,
                mode=mode,
                marker={"color": colour, "size": 5},
                line={"color": colour, "width": 2, "dash": dash},
                row=row + 1,
                col=column + 1,
            )
        if key != "nees":
            drawn = [value for values, _, _ in lines.values() for value in values]
            shown.update_yaxes(
                type="log",
                **track_html.log_ticks(min(drawn), max(drawn)),
                row=row + 1,
                col=column + 1,
            )
    shown.update_xaxes(range=[0.5, steps[-1] + 0.5])
    shown.add_hrect(low, high, row=2, col=2, line_width=0, fillcolor="#868e96", opacity=0.25)
    shown.update_xaxes(title_text="time step", title_standoff=4)
    shown.update_annotations(font_size=13)
    legend = {"orientation": "h", "x": 0, "y": 1.06, "yanchor": "bottom"}
    shown.update_layout(
        height=680,
        template="plotly_white",
        legend=legend,
        margin={"l": 50, "r": 10, "t": 60, "b": 40},
    )
    return shown


def replay_page(recording: Recording, replayed: Replayed) -> str:
    """Write the page of a recording: track, errors (with truth), and figures of the run."""
    settings, track, result = replayed.settings, replayed.track, replayed.figures
    truth = truth_of(recording, track, settings)
    times = track.times - track.times[0]
    # Data of 3-D pictures have seven digits, those of a map need more.
    origin = origin_of(recording)
    places = track.translation - origin
    beliefs = {
        settings.filter: Beliefs(track.rotation, places, track.covariance, COLOURS["iterated EKF"])
    }
    if replayed.smoothed is not None:
        best = replayed.smoothed.track
        beliefs["smoothed"] = Beliefs(
            best.rotation, best.translation - origin, best.covariance, COLOURS["KF"]
        )
    shown = None if truth is None else (truth.rotation, truth.translation - origin, truth.known)
    story = Story(
        times,
        recording.last_anchors - origin,
        recording.anchor_ids,
        recording.tags,
        shown,
        beliefs,
        "xy" if (settings.knowledge.planar if truth is None else truth.planar) else "xyz",
    )
    parts = [*map(page.note, result["notes"]), page.note(_LEGEND)]
    if origin.any():
        shift = ", ".join(f"{x:.0f}" for x in origin)
        parts.append(page.note(f"Coordinates are relative to ({shift}) m."))
    parts.append(page.plot(track_html.track_figure(story), "track"))
    if truth is not None:
        axes, is_open = result["position_axes"], turn_open(result)
        for title in ("errors", "smoothed")[: len(beliefs)]:
            found = error_rows(result if title == "errors" else result[title], axes, is_open)
            rows = [[label, *cells] for label, cells in found]
            parts.append(page.table(title, ["error", "RMSE", "median", "p95"], rows))
        smoothed = f", smoothed {result['smoothed']['anees']:.2f}" if len(beliefs) > 1 else ""
        parts.append(
            page.note(
                f"NEES per degree of freedom {result['anees']:.2f}{smoothed} (1: consistent; "
                "above: overconfident; below: too cautious); "
                f"{'; '.join(compared(result))}."
            )
        )
    parts += consistency_parts(replayed)
    parts.append(track_html.anchors_table(story))
    used = [
        [name.replace("_", " "), str(value) if isinstance(value, tuple) else value]
        for name, value in result["settings"].items()
    ]
    parts.append(page.table("settings", ["setting", "value"], used))
    title = f"{result['epochs']} epochs, {result['links']} ranges, filter {settings.filter}"
    return page.document(f"A recording replayed: {title}", parts)
