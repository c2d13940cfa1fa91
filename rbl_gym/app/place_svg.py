"""The plan of a placement as SVG: maps, labels of fixed size, readout on touch."""

from __future__ import annotations

import base64
import html
import io
import json
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex, to_rgb

from rbl_gym.app import place_answer
from rbl_gym.app import place_shapes as shapes
from rbl_gym.app.place_draw import COLOURS, KEPT, MOUNT
from rbl_gym.app.place_figures import anchor_names, legend_text, map_panels
from rbl_gym.checks import FloatArray
from rbl_gym.rendering.drawing import round_number
from rbl_gym.studies.placing.accuracy import Map
from rbl_gym.studies.placing.answer import Placed

# Width of the SVG in its own units; zoom of hatched pictures.
_WIDTH, _ZOOM = 1000.0, 6
# Heights of maps as fractions of a zone's height, by name.
_LEVELS = (("bottom", 0.0), ("middle", 0.5), ("top", 1.0))
# With more zones than this only the middle height is shown.
_FEW = 6


def answer_part(result: dict[str, Any]) -> str:
    """Return the verdicts in words, with signs."""
    rows = []
    for zone in place_answer.zone_answers(result):
        badge = ""
        if zone.verdict != "no requirement":
            sign = place_answer.SIGNS[zone.verdict]
            badge = f'<span class="badge {zone.verdict}">{sign}</span>'
        said = "; ".join(part for part in (zone.reached, zone.figures) if part)
        asks = f"<br><small>asks for {html.escape(zone.asks)}</small>" if zone.asks else ""
        rows.append(
            f"<div>{badge}</div><p><b>{html.escape(zone.name)}</b>{asks}<br>{html.escape(said)}</p>"
        )
    return f'<section class="answer">{"".join(rows)}</section>'


def plan_part(placed: Placed) -> str:
    """Return the plan with its controls, as HTML."""
    problem, anchors = placed.problem, placed.design.anchors
    edges = shapes.limits(problem, anchors)
    scale = _WIDTH / float(np.ptp(edges[:, 0]))
    size = np.ptp(edges, axis=0) * scale
    panels = map_panels(problem)
    levels = _LEVELS if len(problem.zones) <= _FEW else _LEVELS[1:2]
    levels = levels if any(z.high_m > z.low_m for z in problem.zones) else _LEVELS[1:2]
    middle = len(levels) // 2
    maps = [shapes.maps_of(placed, share) for _, share in levels]
    ranges = {
        q.field: shapes.colour_range(
            [layer for one in maps for layer in shapes.layers(problem, one, q.field)],
            _limit(problem, q),
        )
        for q in panels
    }
    draw = _Drawing(edges, scale)
    clips = "".join(
        f'<clipPath id="zone{k}">{draw.polygon(zone.polygon)}</clipPath>'
        for k, zone in enumerate(problem.zones)
    )
    groups = "".join(
        f'<g data-map="{q.field}/{k}">{_images(draw, problem, one, q, ranges[q.field])}</g>'
        for k, one in enumerate(maps)
        for q in panels
    )
    svg = (
        f'<svg viewBox="0 0 {size[0]:.1f} {size[1]:.1f}" role="img" aria-label="plan">'
        f"<defs>{clips}</defs>{_backdrop(draw, problem)}<g class='maps'>{groups}</g>"
        f"{_building(draw, placed)}"
        "<g class='leaders' stroke='#333' vector-effect='non-scaling-stroke'></g></svg>"
    )
    case = place_answer.case_of_maps(placed.result)
    case = f'<p class="note">The maps show the errors {case}.</p>' if case else ""
    return (
        f'<figure class="plan">{_controls(panels, levels)}'
        f'<div class="stage" style="aspect-ratio: {size[0]:.1f} / {size[1]:.1f}">{svg}'
        f"{_labels(placed, edges)}</div>{_ruler(edges)}"
        f"{''.join(_scale(problem, q, ranges[q.field]) for q in panels)}"
        f'<p class="note">{html.escape(" · ".join(legend_text(problem).split("     ")))}</p>'
        f"{case}"
        '<p class="readout">Touch the map or an anchor to see its values.</p>'
        f'<script type="application/json">{_data(placed, panels, maps, edges, middle)}</script>'
        "</figure>"
    )


def _ruler(edges: FloatArray) -> str:
    """Return a bar of a round length below the plan, and the directions of the axes."""
    width = float(np.ptp(edges[:, 0]))
    length = round_number(width / 4)
    x, y = edges[0]
    return (
        f'<div class="ruler" style="width: {100 * length / width:.2f}%">{length:g} m</div>'
        f'<p class="note">x points to the right, y up; the lower left corner of the plan is at '
        f"x = {x:.4g} m, y = {y:.4g} m</p>"
    )


class _Drawing:
    """Converts metres to the units of an SVG."""

    def __init__(self, edges: FloatArray, scale: float) -> None:
        self.edges, self.scale = edges, scale

    def points(self, points: FloatArray) -> list[str]:
        """Return coordinates as texts."""
        x = (points[:, 0] - self.edges[0, 0]) * self.scale
        y = (self.edges[1, 1] - points[:, 1]) * self.scale
        return [f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True)]

    def polygon(self, points: FloatArray, style: str = "") -> str:
        """Return a polygon."""
        return f'<polygon points="{" ".join(self.points(points))}" {style}/>'

    def lines(self, lines: list[FloatArray], style: str) -> str:
        """Return lines (n, 2) as one path."""
        path = "".join(f"M{' L'.join(self.points(line))}" for line in lines)
        return f'<path d="{path}" fill="none" vector-effect="non-scaling-stroke" {style}/>'

    def image(self, data: str, box: tuple[float, float, float, float], style: str = "") -> str:
        """Return a picture in a box: left, right, bottom, top."""
        left, right, bottom, top = box
        x, y = self.points(np.array([[left, top]]))[0].split(",")
        width, height = (right - left) * self.scale, (top - bottom) * self.scale
        return (
            f'<image x="{x}" y="{y}" width="{width:.1f}" height="{height:.1f}" '
            f'preserveAspectRatio="none" href="{data}" {style}/>'
        )


def _backdrop(draw: _Drawing, problem: Any) -> str:
    plan = problem.plan
    if plan is None or plan.image is None:
        return ""
    from PIL import Image

    with Image.open(plan.image) as image:
        width, height = image.size
        shown = image.convert("RGB")
        shown.thumbnail((1600, 1600))
    x, y = plan.origin
    box = (x, x + width * plan.metres_per_pixel, y, y + height * plan.metres_per_pixel)
    return draw.image(_uri(shown), box, 'opacity="0.55"')


def _building(draw: _Drawing, placed: Placed) -> str:
    """Return obstacles, mounts, zones and markers."""
    problem, anchors = placed.problem, placed.design.anchors
    parts = []
    for solid in shapes.solids_in_plan(problem):
        level = round(255 * float(shapes.grey(solid.share)))
        style = f'fill="rgb({level},{level},{level})" stroke="#333" stroke-width="0.6"'
        if shapes.is_overhead(problem, solid):
            style = 'fill="none" stroke="#333" stroke-width="0.6" stroke-dasharray="1 2"'
        parts.append(draw.polygon(solid.corners, style))
    if not shapes.is_far(problem, anchors):
        lines, _ = shapes.mount_shapes(problem)
        parts.append(draw.lines(lines, f'stroke="{MOUNT}" stroke-width="1.6" opacity="0.8"'))
    for zone in problem.zones:
        style = 'stroke="#222" stroke-width="1.2" stroke-dasharray="5 3"'
        parts.append(draw.lines(shapes.sides_of(zone.polygon), style))
    return "".join(parts)


def _labels(placed: Placed, edges: FloatArray) -> str:
    """Return names of zones and markers of anchors, elements of fixed size over the SVG."""
    problem, anchors = placed.problem, placed.design.anchors
    parts = []
    for name, anchor, row in zip(
        anchor_names(placed), anchors, placed.result["anchors"], strict=True
    ):
        place, outside = shapes.shown_place(anchor[:2], edges)
        told = f"anchor {name}: x {anchor[0]:.3f}, y {anchor[1]:.3f}, z {anchor[2]:.3f} m"
        told += f", {row['mount']}" if row.get("mount") else ""
        told += f", sees {place_answer.percent(row['sees'])} of the zones" if "sees" in row else ""
        away = f" {np.linalg.norm(anchor - np.mean(problem.corners(), axis=0)):.3g} m away"
        sign = "■" if shapes.is_kept(problem, anchor) else "▲"
        x, y = _share(place, edges)
        colour = KEPT if sign == "■" else "#111"
        parts.append(
            f'<span style="position:absolute;left:{100 * x:.2f}%;top:{100 * y:.2f}%;'
            f"transform:translate(-50%,-50%);font-size:13px;line-height:1;color:{colour};"
            f'-webkit-text-stroke:.6px #fff;pointer-events:none">{sign}</span>'
            f'<span class="label anchor" data-x="{x:.5f}" data-y="{y:.5f}" '
            f'title="{html.escape(told)}">{html.escape(name)}{away if outside else ""}</span>'
        )
    if len(problem.zones) > 1:
        for text, at in shapes.zone_labels(problem, anchors):
            x, y = _share(at, edges)
            parts.append(
                f'<span class="label zone" data-x="{x:.5f}" data-y="{y:.5f}">'
                f"{'<br>'.join(map(html.escape, text.splitlines()))}</span>"
            )
    return "".join(parts)


def _share(place: FloatArray, edges: FloatArray) -> tuple[float, float]:
    """Return a position as fractions of the width from the left and of the height from the top."""
    x, y = (place - edges[0]) / np.ptp(edges, axis=0)
    return float(x), 1 - float(y)


def _controls(panels: list[shapes.Quantity], levels: Any) -> str:
    buttons = [f'<button data-map="{q.field}">{q.name}</button>' for q in panels]
    if len(levels) > 1:
        buttons.append("<span>at the zones'</span>")
        buttons += [
            f'<button data-level="{k}">{name}</button>' for k, (name, _) in enumerate(levels)
        ]
    return f'<div class="controls">{"".join(buttons)}</div>'


def _limit(problem: Any, quantity: shapes.Quantity) -> float | None:
    limits = [quantity.limit_of(zone) for zone in problem.zones]
    return max((limit for limit in limits if limit is not None), default=None)


# --- maps ------------------------------------------------------------------------------------


def _images(
    draw: _Drawing,
    problem: Any,
    maps: list[Map],
    quantity: shapes.Quantity,
    span: tuple[float, float],
) -> str:
    """Return the map of each zone, clipped to it; hatched beyond its limit."""
    parts = []
    for k, layer in enumerate(shapes.layers(problem, maps, quantity.field)):
        box = (layer.left, layer.right, layer.bottom, layer.top)
        clip = f'clip-path="url(#zone{k})"'
        if quantity.field == "relative":
            parts.append(draw.image(_uri(_verdict_image(layer)), box, clip))
            continue
        share = np.clip((layer.values - span[0]) / (span[1] - span[0]), 0, 1)
        image = (255 * colormaps[COLOURS](np.nan_to_num(share))[..., :3]).astype(np.uint8)
        parts.append(draw.image(_uri(_picture(image)), box, clip))
        limit = quantity.limit_of(layer.zone)
        if limit is not None and (layer.values > limit).any():
            beyond = shapes.enlarged(layer.values, _ZOOM) > limit
            stripes = np.zeros((*beyond.shape, 4), np.uint8)
            stripes[beyond & _stripes(beyond.shape)] = 255
            parts.append(draw.image(_uri(_picture(stripes)), box, clip))
    return "".join(parts)


def _verdict_image(layer: shapes.Layer) -> Any:
    """Return an image in two colours, with stripes on the second."""
    if not layer.free.any():
        return _picture(np.full((1, 1, 3), _rgb(shapes.NOTHING), np.uint8))
    beyond = shapes.enlarged(layer.values, _ZOOM) > 1
    image = np.where(beyond[..., None], _rgb(shapes.BEYOND), _rgb(shapes.WITHIN))
    image[beyond & _stripes(beyond.shape)] = 255
    return _picture(image.astype(np.uint8))


def _stripes(shape: tuple[int, ...]) -> np.ndarray:
    rows, columns = np.indices(shape)
    return (rows + columns) % 9 < 2


def _rgb(colour: str) -> np.ndarray:
    return np.rint(255 * np.array(to_rgb(colour)))


def _picture(pixels: np.ndarray) -> Any:
    """Return an image, its rows from the bottom."""
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(pixels[::-1]))
    return image if pixels.shape[-1] == 4 else image.quantize(128)


def _uri(image: Any) -> str:
    data = io.BytesIO()
    image.save(data, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(data.getvalue()).decode()


def _scale(problem: Any, quantity: shapes.Quantity, span: tuple[float, float]) -> str:
    """Return the legend of a map."""
    if quantity.field == "relative":
        keys = [
            f'<span class="key" style="background:{shapes.WITHIN}"></span>within the requirement',
            '<span class="key hatch"></span>not within',
        ]
        if any(not zone.has_requirement for zone in problem.zones):
            key = f'<span class="key" style="background:{shapes.NOTHING}"></span>no requirement'
            keys.append(key)
        inner = "".join(f"<span>{key}</span>" for key in keys)
    else:
        stops = ", ".join(to_hex(colormaps[COLOURS](x)) for x in np.linspace(0, 1, 9))
        low, high = (place_answer.digits(value) for value in span)
        inner = (
            f"<span>error of {quantity.name}, one sigma: {low} {quantity.unit}</span>"
            f'<span class="bar" style="background:linear-gradient(90deg, {stops})"></span>'
            f"<span>{high} {quantity.unit} and more</span>"
        )
        if _limit(problem, quantity) is not None:
            inner += "<span>(striped: beyond the requirement)</span>"
    return f'<div class="scale" data-map="{quantity.field}">{inner}</div>'


def _data(
    placed: Placed,
    panels: list[shapes.Quantity],
    maps: list[list[Map]],
    edges: FloatArray,
    middle: int,
) -> str:
    """Return the data of the readout, as JSON."""
    problem = placed.problem
    names = {q.field: f"{q.name} # {q.unit}" for q in panels}
    names["relative"] = "# of the limit"
    rows = []
    for one in maps:
        row = []
        for zone, plane in zip(problem.zones, one, strict=True):
            values = {q.field: _numbers(shapes.values_of(zone, plane, q.field)) for q in panels}
            layer = shapes.layer_of(zone, plane, plane.position)
            box = {key: round(getattr(layer, key), 4) for key in ("left", "right", "bottom", "top")}
            row.append({"zone": zone.name, "at": f"{plane.at:.3g}", **box, "values": values})
        rows.append(row)
    data = {
        "first": panels[0].field,
        "level": middle,
        "low": edges[0].tolist(),
        "high": edges[1].tolist(),
        "names": names,
        "maps": rows,
    }
    return json.dumps(data, separators=(",", ":")).replace("</", "<\\/")


def _numbers(values: FloatArray) -> list[list[float | None]]:
    return [
        [float(f"{value:.3g}") if np.isfinite(value) else None for value in row]
        for row in values.tolist()
    ]
