"""The script of the section of terrain: a line on the picture, and heights along it."""

from pancam_graph.report._blink import BLINKING
from pancam_graph.report._packed import UNPACKED

__all__ = ["TERRAIN_SCRIPT", "UNKNOWN"]

UNKNOWN = -32_768
"""Code of a height that is not known."""
TERRAIN_SCRIPT = (
    r"""
"use strict";
(async () => {
  """
    + UNPACKED
    + BLINKING
    + r"""
  const make = (kind, attributes, text) => {
    const element = document.createElementNS("http://www.w3.org/2000/svg", kind);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    if (text !== undefined) element.textContent = text;
    return element;
  };
  const surfaces = JSON.parse(document.getElementById("terrain-surfaces").textContent);
  const numbers = new Int16Array(await unpacked("packed-terrain", true));
  const reliefs = [...document.querySelectorAll(".relief")];
  const which = document.getElementById("terrain-surface");
  const picture = document.getElementById("terrain-picture");
  const button = document.getElementById("terrain-blink");
  const plot = document.getElementById("terrain-profile");
  const readout = document.getElementById("terrain-readout");
  const ends = surfaces.map((s) => s.line.map((end) => [...end]));

  const value = (s, band, column, row) => {
    const number = numbers[s.first + (band * s.rows + row) * s.columns + column];
    return number === """
    + str(UNKNOWN)
    + r""" ? NaN : s.base[band] + number * s.step[band];
  };
  // The cell whose middle is nearest: heights between cells would hide holes.
  const at = (s, band, x, y) => {
    const column = Math.floor((x - s.left) / s.cell), row = Math.floor((s.top - y) / s.cell);
    const inside = column >= 0 && row >= 0 && column < s.columns && row < s.rows;
    return inside ? value(s, band, column, row) : NaN;
  };
  const ticks = (low, high, wanted) => {
    const raw = (high - low) / wanted, power = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].map((k) => k * power).find((k) => k >= raw * 0.999);
    const out = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) out.push(k * step);
    return [out, Math.max(0, -Math.floor(Math.log10(step) + 1e-9))];
  };
  const path = (points) => {
    let text = "", pen = false;
    for (const [x, y] of points) {
      const seen = Number.isFinite(y);
      if (seen) text += `${pen ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`;
      pen = seen;
    }
    return text;
  };

  const draw = () => {
    const s = surfaces[which.value], [[ax, ay], [bx, by]] = ends[which.value];
    const length = Math.hypot(bx - ax, by - ay), n = Math.max(2, Math.ceil(length / s.cell * 1.5));
    const samples = Array.from({length: n + 1}, (_, k) => {
      const share = k / n, x = ax + share * (bx - ax), y = ay + share * (by - ay);
      return [share * length, at(s, 0, x, y), at(s, 1, x, y), at(s, 2, x, y)];
    });
    const heights = samples.flatMap((v) => [v[1], v[2]]).filter(Number.isFinite);
    const width = plot.clientWidth || 640, height = plot.clientHeight || 300;
    plot.setAttribute("viewBox", `0 0 ${width} ${height}`);
    plot.replaceChildren();
    const coordinates = `from (${ax.toFixed(1)}, ${ay.toFixed(1)}) to (${bx.toFixed(1)}, ${by.toFixed(1)}) m`;
    if (heights.length === 0 || length === 0) {
      plot.append(make("text", {x: 20, y: 40}, "Nothing is seen along this line."));
      readout.textContent = `Line ${coordinates}: nothing is seen along it.`;
      return;
    }
    let low = Math.min(...heights), high = Math.max(...heights);
    const margin = Math.max(0.08 * (high - low), 0.005);
    low -= margin; high += margin;
    const left = 62, right = width - 14, top = 34, bottom = height - 44;
    const px = (d) => left + d / length * (right - left);
    const py = (z) => bottom - (z - low) / (high - low) * (bottom - top);
    const [across, acrossDigits] = ticks(0, length, Math.max(3, (right - left) / 110));
    const [up, upDigits] = ticks(low, high, 5);
    for (const d of across) {
      plot.append(make("line", {class: "grid", x1: px(d), x2: px(d), y1: top, y2: bottom}));
      plot.append(make("text", {x: px(d), y: bottom + 16, "text-anchor": "middle"}, d.toFixed(acrossDigits)));
    }
    for (const z of up) {
      plot.append(make("line", {class: "grid", x1: left, x2: right, y1: py(z), y2: py(z)}));
      plot.append(make("text", {x: left - 6, y: py(z) + 4, "text-anchor": "end"}, z.toFixed(upDigits)));
    }
    const under = {x: (left + right) / 2, y: height - 8, "text-anchor": "middle"};
    plot.append(make("text", under, "along the line, m"));
    const name = make("text", {x: 14, y: (top + bottom) / 2, "text-anchor": "middle"}, "height, m");
    name.setAttribute("transform", `rotate(-90 14 ${(top + bottom) / 2})`);
    plot.append(name);
    for (const v of samples) {
      if (!Number.isFinite(v[1]) || !Number.isFinite(v[3])) continue;
      const half = 0.5 * (right - left) / n;
      plot.append(make("rect", {class: "band", x: px(v[0]) - half, width: 2 * half,
        y: py(v[1] + v[3]), height: Math.max(0, py(v[1] - v[3]) - py(v[1] + v[3]))}));
    }
    plot.append(make("path", {class: "telemetry", d: path(samples.map((v) => [px(v[0]), py(v[2])]))}));
    plot.append(make("path", {class: "refined", d: path(samples.map((v) => [px(v[0]), py(v[1])]))}));
    plot.append(make("line", {class: "refined", x1: left, x2: left + 28, y1: 18, y2: 18}));
    plot.append(make("text", {x: left + 34, y: 22}, "refined, ± sigma"));
    if (s.telemetry) {
      plot.append(make("line", {class: "telemetry", x1: left + 150, x2: left + 178, y1: 18, y2: 18}));
      plot.append(make("text", {x: left + 184, y: 22}, "telemetry"));
    }
    const known = samples.map((v) => v[1]).filter(Number.isFinite);
    const rise = known.length ? Math.max(...known) - Math.min(...known) : NaN;
    const sigmas = samples.map((v) => v[3]).filter(Number.isFinite).sort((a, b) => a - b);
    const sigma = (1e3 * sigmas[sigmas.length >> 1]).toFixed(1);
    readout.textContent = `Line ${coordinates}, ${length.toFixed(2)} m` + (known.length
      ? `; heights span ${rise.toFixed(3)} m, sigma ${sigma} mm (median)` : "");
  };

  const place = () => {
    const k = Number(which.value), s = surfaces[k], svg = reliefs[k].querySelector("svg");
    const toPicture = ([x, y]) => [(x - s.left) / s.wide * s.width, (s.top - y) / s.high * s.height];
    const [a, b] = ends[k].map(toPicture);
    for (const line of svg.querySelectorAll("line")) {
      line.setAttribute("x1", a[0]); line.setAttribute("y1", a[1]);
      line.setAttribute("x2", b[0]); line.setAttribute("y2", b[1]);
    }
    [...svg.querySelectorAll("circle")].forEach((circle, n) => {
      circle.setAttribute("cx", [a, b][n][0]); circle.setAttribute("cy", [a, b][n][1]);
    });
    draw();
  };

  const show = () => {
    const k = Number(which.value), s = surfaces[k];
    reliefs.forEach((relief, n) => {
      relief.hidden = n !== k;
      for (const image of relief.querySelectorAll("img")) {
        image.hidden = image.dataset.kind !== picture.value;
      }
    });
    for (const option of picture.options) {
      option.disabled = option.value === "telemetry" && !s.telemetry;
    }
    button.disabled = !s.telemetry;
    if (picture.value === "telemetry" && !s.telemetry) { picture.value = "refined"; show(); return; }
    place();
  };

  reliefs.forEach((relief, k) => {
    const s = surfaces[k], svg = relief.querySelector("svg");
    const world = (event) => {
      const box = svg.getBoundingClientRect();
      const share = (v) => Math.min(1, Math.max(0, v));
      return [s.left + share((event.clientX - box.left) / box.width) * s.wide,
        s.top - share((event.clientY - box.top) / box.height) * s.high];
    };
    let held = null;
    svg.addEventListener("pointerdown", (event) => {
      const grabbed = [...svg.querySelectorAll("circle")].indexOf(event.target);
      held = grabbed >= 0 ? grabbed : 1;
      if (grabbed < 0) ends[k] = [world(event), world(event)];
      svg.setPointerCapture(event.pointerId);
      place();
    });
    svg.addEventListener("pointermove", (event) => {
      if (held === null) return;
      ends[k][held] = world(event);
      place();
    });
    for (const kind of ["pointerup", "pointercancel"]) svg.addEventListener(kind, () => { held = null; });
    [...svg.querySelectorAll("circle")].forEach((circle, n) => circle.addEventListener("keydown", (event) => {
      const step = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1]}[event.key];
      if (!step) return;
      event.preventDefault();
      const far = event.shiftKey ? 10 : 1, [x, y] = ends[k][n];
      ends[k][n] = [Math.min(s.left + s.wide, Math.max(s.left, x + far * step[0] * s.cell)),
        Math.min(s.top, Math.max(s.top - s.high, y + far * step[1] * s.cell))];
      place();
    }));
  });

  const swap = () => { picture.value = picture.value === "refined" ? "telemetry" : "refined"; show(); };
  const stop = blinking(button, swap);
  picture.addEventListener("change", () => { stop(); show(); });
  which.addEventListener("change", () => { stop(); show(); });
  addEventListener("resize", draw);
  show();
})();
"""
)
