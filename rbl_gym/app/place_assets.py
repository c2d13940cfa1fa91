"""Style and script of the page of a placement, for the output of `place_svg`."""

STYLE = """
.plan .ruler { border: 1.5px solid #222; border-top: 0; height: .5em; text-align: center;
               font-size: .85em; line-height: 2.4; margin: .4em 0 1.4em; }
.plan { margin: 1em 0; } .plan .stage { position: relative; width: 100%; touch-action: pan-y; }
.plan svg { position: absolute; inset: 0; width: 100%; height: 100%; overflow: visible; }
.plan .maps g { display: none; } .plan .maps g.on { display: inline; }
.plan .scale { display: none; } .plan .scale.on { display: flex; }
.plan .label { position: absolute; font: 600 12px/1.25 system-ui, sans-serif; padding: 0 .3em;
  background: rgba(255,255,255,.9); border: 1px solid #999; border-radius: 3px; color: #111;
  transform: translate(-50%, -50%); white-space: nowrap; cursor: pointer; }
.plan .zone { font-weight: 400; border-color: #ccc; cursor: default; pointer-events: none; }
.plan .controls { display: flex; flex-wrap: wrap; gap: .4em; margin: .6em 0; }
.plan .controls button { font: inherit; font-size: .9em; padding: .3em .7em; border: 1px solid #888;
  border-radius: 4px; background: #fff; cursor: pointer; min-height: 2.2em; }
.plan .controls button[aria-pressed=true] { background: #222; color: #fff; border-color: #222; }
.plan .controls span { align-self: center; color: #555; font-size: .9em; }
.plan .scale { align-items: center; gap: .5em; font-size: .85em; flex-wrap: wrap; min-height: 2em; }
.plan .bar { height: 12px; width: 10em; border: 1px solid #888; }
.plan .key { display: inline-block; width: 1.6em; height: .9em; border: 1px solid #555;
  vertical-align: -.1em; margin-right: .3em; }
.plan .hatch { background: repeating-linear-gradient(135deg, #fff 0 2px, #d55e00 2px 6px); }
.plan .readout { min-height: 1.5em; font-size: .9em; font-variant-numeric: tabular-nums; }
.answer { display: grid; grid-template-columns: auto 1fr; gap: .5em .9em; align-items: start;
  margin: 1em 0; } .answer p { margin: 0; } .answer small { color: #444; }
.badge { font-weight: 700; border: 1px solid #000; border-radius: 5px; padding: .1em .5em;
  white-space: nowrap; } .badge.pass { background: #56b4e9; }
.badge.undecided { background: #f0e442; }
.badge.fail { background: #d55e00; color: #fff; }
.scene { height: min(640px, 100vw); overflow: hidden; }
.scene > div { height: 100%; }
@media print { .plan .controls { display: none; } }
"""
SCRIPT = """
document.querySelectorAll(".plan").forEach(plan => {
  const stage = plan.querySelector(".stage"), svg = plan.querySelector("svg");
  const readout = plan.querySelector(".readout");
  const data = JSON.parse(plan.querySelector("script").textContent);
  let shown = data.first, level = data.level;
  const draw = () => {
    plan.querySelectorAll(".maps g").forEach(g =>
      g.classList.toggle("on", g.dataset.map === shown + "/" + level));
    plan.querySelectorAll(".scale").forEach(s =>
      s.classList.toggle("on", s.dataset.map === shown));
    plan.querySelectorAll("button[data-map]").forEach(b =>
      b.setAttribute("aria-pressed", b.dataset.map === shown));
    plan.querySelectorAll("button[data-level]").forEach(b =>
      b.setAttribute("aria-pressed", Number(b.dataset.level) === level));
  };
  plan.querySelectorAll("button").forEach(b => b.addEventListener("click", () => {
    if (b.dataset.map) shown = b.dataset.map; else level = Number(b.dataset.level);
    draw();
  }));
  const tell = event => {
    const box = stage.getBoundingClientRect();
    const x = data.low[0] + (event.clientX - box.left) / box.width * (data.high[0] - data.low[0]);
    const y = data.high[1] - (event.clientY - box.top) / box.height * (data.high[1] - data.low[1]);
    let text = `x ${x.toFixed(2)}, y ${y.toFixed(2)} m`;
    for (const map of data.maps[level]) {
      const rows = map.values[shown], column = (x - map.left) / (map.right - map.left);
      const row = (y - map.bottom) / (map.top - map.bottom);
      if (!rows || column < 0 || column >= 1 || row < 0 || row >= 1) continue;
      const line = rows[Math.floor(row * rows.length)];
      const value = line[Math.floor(column * line.length)];
      if (value === null) continue;
      text += `, z ${map.at} m (${map.zone}): ` + data.names[shown].replace("#", value);
    }
    readout.textContent = text;
  };
  stage.addEventListener("pointermove", tell);
  stage.addEventListener("pointerdown", tell);
  plan.querySelectorAll(".anchor").forEach(label => label.addEventListener("pointerdown", event => {
    event.stopPropagation(); readout.textContent = label.title;
  }));
  // Labels keep their size: none lies on another, whatever the width of the page.
  const lines = svg.querySelector(".leaders");
  const settle = () => {
    const box = stage.getBoundingClientRect(), placed = [], size = 8;
    const labels = [...plan.querySelectorAll(".label")];
    const marks = labels.filter(l => l.classList.contains("anchor")).map(l =>
      [l.dataset.x * box.width, l.dataset.y * box.height]);
    lines.replaceChildren();
    for (const label of labels) {
      const w = label.offsetWidth / 2 + 1, h = label.offsetHeight / 2 + 1;
      const px = label.dataset.x * box.width, py = label.dataset.y * box.height;
      const own = label.classList.contains("zone");
      let best = null, least = Infinity;
      for (let ring = 0; ring < 7; ring++) for (let k = 0; k < 12; k++) {
        const turn = (k * 5 % 12 + .8) * Math.PI / 6, reach = own ? ring * 14 : 3 + ring * 12;
        const cx = px + Math.cos(turn) * (own ? reach : w + size * .6 + reach);
        const cy = py - Math.sin(turn) * (own ? reach : h + size * .6 + reach);
        let cost = ring + k * .02;
        for (const [x, y, a, b] of placed)
          if (Math.abs(cx - x) < w + a && Math.abs(cy - y) < h + b) cost += 20;
        for (const [x, y] of marks)
          if (Math.abs(cx - x) < w + size * .7 && Math.abs(cy - y) < h + size * .7) cost += 6;
        if (cx - w < -8 || cx + w > box.width + 8) cost += 12;
        if (cy - h < -8 || cy + h > box.height + 8) cost += 12;
        if (cost < least) { least = cost; best = [cx, cy]; }
      }
      placed.push([best[0], best[1], w, h]);
      label.style.left = best[0] + "px"; label.style.top = best[1] + "px";
      if (!own && Math.hypot(best[0] - px, best[1] - py) > w + 14) {
        const line = document.createElementNS("http://www.w3.org/2000/svg", "line");
        const to = svg.viewBox.baseVal;
        line.setAttribute("x1", px / box.width * to.width);
        line.setAttribute("y1", py / box.height * to.height);
        line.setAttribute("x2", best[0] / box.width * to.width);
        line.setAttribute("y2", best[1] / box.height * to.height);
        lines.append(line);
      }
    }
  };
  new ResizeObserver(settle).observe(stage);
  draw(); settle();
});
"""
