"""Mosaics in the page: the picture of one place with each pointing, shown in turn or faded by a slider."""

from itertools import groupby

from pancam_graph.mosaic import Blink, WrittenMosaics
from pancam_graph.report._blink import BLINKING
from pancam_graph.report._escaped import escape
from pancam_graph.report._packed import jpeg_uri

__all__ = ["mosaic_section"]

_STYLE = """
.blink { margin: 0; }
.blink .stack { position: relative; width: fit-content; max-width: 100%; }
.blink img { display: block; max-width: 100%; height: auto; border: 1px solid var(--line); }
.blink img.after { position: absolute; inset: 0; }
.controls input[type=range] { width: 220px; vertical-align: middle; }
.blink figcaption { margin-top: 6px; font-weight: 600; min-height: 1.5em; overflow-wrap: anywhere; }
@media print { #mosaics .controls { display: none; } }
.seams li { overflow-wrap: anywhere; max-width: 130ch; }
"""
_SCRIPT = (
    r"""
"use strict";
(() => {
"""
    + BLINKING
    + r"""
  const blinks = [...document.querySelectorAll(".blink")];
  const select = document.getElementById("mosaic-view");
  const slider = document.getElementById("mosaic-fade");
  const button = document.getElementById("mosaic-blink");
  const show = () => blinks.forEach((blink, row) => {
    blink.hidden = row !== Number(select.value);
    const share = Number(slider.value) / 100;
    const words = share === 0 ? blink.dataset.before
      : share === 1 ? blink.dataset.after
        : `${Math.round(100 * share)} % refined over telemetry`;
    const [before, after] = blink.querySelectorAll("img");
    after.style.opacity = share;
    before.ariaHidden = String(share > 0.5);
    after.ariaHidden = String(share <= 0.5);
    blink.querySelector("figcaption").textContent = words;
    if (!blink.hidden) slider.setAttribute("aria-valuetext", words);
  });
  const swap = () => { slider.value = Number(slider.value) < 50 ? 100 : 0; show(); };
  const stop = blinking(button, swap);
  slider.addEventListener("input", () => { stop(); show(); });
  select.addEventListener("change", show);
  show();
})();
"""
)
_CAPTION = (
    "Blink shows both pointings in turn; where the system asks for less motion, each press swaps them. The "
    "slider fades. Both are on the surface that the adjusted landmarks span, with the same exposures, seams "
    "and contrast: only the pointing differs. Overlaps are four times enlarged, the first image in red and "
    "the second in green and blue: grey where they agree. The seam error is the median displacement of "
    "windows of 64 pixels, by phase correlation, in pixels of the images at their centre. Pictures in full, "
    "and where their pixels are in the world: folder mosaics beside this page; mosaics.html there zooms."
)


def mosaic_section(written: WrittenMosaics | None) -> str:
    """The section of the mosaics; nothing where none were made."""
    if written is None or not written.blinks:
        return ""
    groups = groupby(enumerate(written.blinks), key=lambda numbered: numbered[1].group)
    options = "".join(
        f'<optgroup label="{escape(name)}">'
        + "".join(f'<option value="{n}">{escape(b.title)}</option>' for n, b in members)
        + "</optgroup>"
        for name, members in groups
    )
    lines = "".join(f"<li>{escape(line)}</li>" for line in written.lines)
    figures = "\n".join(_figure(blink, hidden=n > 0) for n, blink in enumerate(written.blinks))
    return (
        f'<section id="mosaics">\n<style>{_STYLE}</style>\n<h2>Mosaics</h2>\n<ul class="seams">{lines}</ul>\n'
        '<div class="controls"><label>Picture <select id="mosaic-view">'
        f"{options}</select></label>\n"
        '<button type="button" id="mosaic-blink" aria-pressed="false">Blink</button>\n'
        '<label>telemetry <input type="range" id="mosaic-fade" min="0" max="100" value="100" '
        'aria-label="from telemetry to refined"> refined</label></div>\n'
        f'{figures}\n<p class="caption">{escape(_CAPTION)}</p>\n<script>{_SCRIPT}</script>\n</section>\n'
    )


def _figure(blink: Blink, *, hidden: bool) -> str:
    before, after = (escape(f"{blink.group}: {blink.captions[p]}") for p in ("telemetry", "refined"))
    size = f'width="{blink.width_px}" height="{blink.height_px}"'
    images = "".join(
        f'<img class="{kind}" {size} alt="{escape(blink.title)}, {words}" src="{jpeg_uri(jpeg)}">'
        for kind, words, jpeg in (
            ("before", before, blink.jpeg["telemetry"]),
            ("after", after, blink.jpeg["refined"]),
        )
    )
    return (
        f'<figure class="blink" data-before="{before}" data-after="{after}"{" hidden" if hidden else ""}>'
        f'<div class="stack">{images}</div><figcaption>{after}</figcaption></figure>'
    )
