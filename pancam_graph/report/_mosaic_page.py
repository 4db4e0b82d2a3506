"""A page that shows mosaics at full size: zoomed and moved, with both pointings, and where the cursor is."""

from collections.abc import Sequence
from urllib.parse import quote

from pancam_graph.report._blink import BLINKING
from pancam_graph.report._escaped import escape, script_json
from pancam_graph.report._numbers import Json
from pancam_graph.report._packed import HEAD
from pancam_graph.report._style import STYLE

__all__ = ["make_mosaic_page"]

_KEPT = (
    *("kind", "files", "width_px", "height_px"),
    *("px_per_degree", "left_azimuth_deg", "top_elevation_deg"),
    *("m_per_px", "left_x_m", "top_y_m"),
)
"""What the page needs of an entry of the index."""
_KINDS = {"cylinder": "panorama", "ground": "from above"}
_STYLE = """
#view { position: relative; overflow: hidden; height: 72vh; min-height: 320px; background: #e3e8ec;
  border: 1px solid var(--line); border-radius: 6px; touch-action: none; cursor: grab; }
#view:focus-visible { outline: 3px solid var(--after); }
#view img { position: absolute; left: 0; top: 0; transform-origin: 0 0; max-width: none; }
#view img.sharp { image-rendering: pixelated; }
.controls button { min-width: 0; }
#where { font-variant-numeric: tabular-nums; }
"""
_SCRIPT = (
    r"""
"use strict";
(() => {
"""
    + BLINKING
    + r"""
  const page = JSON.parse(document.getElementById("mosaics-listed").textContent);
  const view = document.getElementById("view"), where = document.getElementById("where");
  const which = document.getElementById("which"), shown = document.getElementById("shown");
  const button = document.getElementById("blink");
  const [before, after] = view.querySelectorAll("img");
  const held = new Map();
  let mosaic, scale = 1, left = 0, top = 0;

  const place = () => {
    const box = view.getBoundingClientRect();
    const wide = mosaic.width_px * scale, high = mosaic.height_px * scale;
    // A part stays in sight, whatever is pulled.
    left = Math.min(box.width - 40, Math.max(40 - wide, left));
    top = Math.min(box.height - 40, Math.max(40 - high, top));
    for (const image of [before, after]) {
      image.style.transform = `translate(${left}px, ${top}px) scale(${scale})`;
      image.classList.toggle("sharp", scale >= 3);
    }
  };
  const fit = () => {
    const box = view.getBoundingClientRect();
    scale = Math.min(box.width / mosaic.width_px, box.height / mosaic.height_px);
    left = (box.width - mosaic.width_px * scale) / 2;
    top = (box.height - mosaic.height_px * scale) / 2;
    place();
  };
  const zoom = (factor, x, y) => {
    const next = Math.min(16, Math.max(0.02, scale * factor));
    left = x - (x - left) * next / scale;
    top = y - (y - top) * next / scale;
    scale = next;
    place();
  };
  const middle = () => {
    const box = view.getBoundingClientRect();
    return [box.width / 2, box.height / 2];
  };
  const say = (x, y) => {
    const u = (x - left) / scale - 0.5, v = (y - top) / scale - 0.5;
    if (u < -0.5 || v < -0.5 || u > mosaic.width_px - 0.5 || v > mosaic.height_px - 0.5) {
      where.textContent = "";
      return;
    }
    if (mosaic.kind === "ground") {
      const east = mosaic.left_x_m + u * mosaic.m_per_px, north = mosaic.top_y_m - v * mosaic.m_per_px;
      where.textContent = `x ${east.toFixed(2)} m, y ${north.toFixed(2)} m of the world`;
      return;
    }
    const azimuth = mosaic.left_azimuth_deg - u / mosaic.px_per_degree;
    const elevation = mosaic.top_elevation_deg - v / mosaic.px_per_degree;
    const turn = (degrees) => ((degrees % 360) + 360) % 360;
    where.textContent = (page.north_deg === null
      ? `azimuth ${turn(azimuth).toFixed(2)}° anticlockwise from the world's x axis`
      : `azimuth ${turn(page.north_deg - azimuth).toFixed(2)}° clockwise from north`)
      + `, elevation ${elevation.toFixed(2)}°`;
  };
  const show = () => { after.style.visibility = shown.value === "refined" ? "visible" : "hidden"; };
  const swap = () => { shown.value = shown.value === "refined" ? "telemetry" : "refined"; show(); };
  const stop = blinking(button, swap);
  const choose = () => {
    mosaic = page.mosaics[which.value];
    before.src = encodeURIComponent(mosaic.files.telemetry);
    after.src = encodeURIComponent(mosaic.files.refined);
    before.alt = `${which.selectedOptions[0].textContent}, telemetry's pointing`;
    after.alt = `${which.selectedOptions[0].textContent}, refined pointing`;
    fit();
  };
  const at = (event) => {
    const box = view.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  view.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...at(event));
  }, {passive: false});
  view.addEventListener("pointerdown", (event) => {
    held.set(event.pointerId, at(event));
    view.setPointerCapture(event.pointerId);
  });
  view.addEventListener("pointermove", (event) => {
    const now = at(event), was = held.get(event.pointerId);
    if (was) {
      const other = [...held].find(([id]) => id !== event.pointerId);
      if (other) {
        const apart = ([ax, ay], [bx, by]) => Math.hypot(ax - bx, ay - by);
        zoom(apart(now, other[1]) / Math.max(1, apart(was, other[1])), ...other[1]);
      } else {
        left += now[0] - was[0];
        top += now[1] - was[1];
        place();
      }
      held.set(event.pointerId, now);
    }
    say(...now);
  });
  for (const kind of ["pointerup", "pointercancel"]) {
    view.addEventListener(kind, (event) => held.delete(event.pointerId));
  }
  view.addEventListener("keydown", (event) => {
    const step = {ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60]}[event.key];
    if (step) { left += step[0]; top += step[1]; place(); }
    else if (event.key === "+" || event.key === "=") zoom(1.5, ...middle());
    else if (event.key === "-") zoom(1 / 1.5, ...middle());
    else return;
    event.preventDefault();
  });
  document.getElementById("in").addEventListener("click", () => zoom(1.5, ...middle()));
  document.getElementById("out").addEventListener("click", () => zoom(1 / 1.5, ...middle()));
  document.getElementById("fit").addEventListener("click", fit);
  document.getElementById("full").addEventListener("click", () => zoom(1 / scale, ...middle()));
  shown.addEventListener("change", () => { stop(); show(); });
  which.addEventListener("change", choose);
  addEventListener("resize", place);
  choose();
  show();
})();
"""
)


def make_mosaic_page(entries: Sequence[Json], north_deg: float | None, name: str) -> str:
    """The page of the mosaics of a traverse, for their own folder.

    `entries` are those of the index of the folder. `north_deg` is the azimuth of north, anticlockwise from
    the world's x axis; None: not known.
    """
    listed = [{key: entry[key] for key in _KEPT if key in entry} for entry in entries]
    page = {"north_deg": north_deg, "mosaics": listed}
    options = "".join(
        f'<option value="{k}">stop {escape(str(e["stop"]))}, camera {escape(str(e["camera"]))}, '
        f"{_KINDS[str(e['kind'])]}</option>"
        for k, e in enumerate(entries)
    )
    head = HEAD.replace("img-src data:", "img-src 'self' file: data:").format(
        title=escape(f"Mosaics of {name}"),
        style=STYLE + _STYLE,
        lead="Mosaics at full size, with telemetry's and with the refined pointing. Drag to move, wheel or "
        "two fingers to zoom; arrow keys, + and - do the same.",
    )
    return (
        f"{head}</header>\n<main>\n"
        f'<div class="controls"><label>Mosaic <select id="which">{options}</select></label>\n'
        '<label>Pointing <select id="shown"><option value="refined">refined</option>'
        '<option value="telemetry">telemetry</option></select></label>\n'
        '<button type="button" id="blink" aria-pressed="false">Blink</button>\n'
        '<button type="button" id="in" aria-label="larger">+</button>'
        '<button type="button" id="out" aria-label="smaller">&minus;</button>'
        '<button type="button" id="fit">Whole</button>'
        '<button type="button" id="full">Full size</button></div>\n'
        '<div id="view" tabindex="0" role="group" aria-label="Mosaic"><img alt=""><img alt=""></div>\n'
        f'<p class="caption" id="where" aria-live="off">&nbsp;</p>\n{_other_views(entries)}</main>\n'
        f'<script type="application/json" id="mosaics-listed">{script_json(page)}</script>\n'
        f"<script>{_SCRIPT}</script>\n</body>\n</html>\n"
    )


def _other_views(entries: Sequence[Json]) -> str:
    """Links to the views from the pole and to the stereo panoramas; nothing where there are none."""
    links = []
    for entry in entries:
        files = entry["files"]
        assert isinstance(files, dict)  # as the index has them
        place = f"stop {entry['stop']}, camera {entry['camera']}"
        for key, file in files.items():
            if key.endswith("_polar"):
                words = f"{place}, from above its mast, {key.removesuffix('_polar')} pointing"
            elif key.startswith("anaglyph_"):
                words = f"{place} with {key.removeprefix('anaglyph_')}, for red and cyan glasses"
            else:
                continue
            links.append(f'<li><a href="{quote(file)}">{escape(words)}</a></li>')
    return f"<h2>Other views</h2>\n<ul>{''.join(links)}</ul>\n" if links else ""
