"""The style sheet of the page."""

__all__ = ["STYLE"]

STYLE = """
:root {
  --ink: #1f2933; --muted: #52606d; --line: #d9e0e6; --soft: #f4f6f8; --after: #0072b2; --warn: #8a4b00;
  --page: #ffffff; --pass: #e9f7f1; --pass-ink: #00543d; --fail: #fdeee6; --fail-ink: #b54300;
  --advice: #fff7e6; --quiet: #667380; --row: #eef1f4; --over: #eef6fb;
  color-scheme: light dark;
}
@media screen and (prefers-color-scheme: dark) {
  :root {
    --ink: #e4e8ec; --muted: #a9b4bf; --line: #3c4650; --soft: #222a31; --after: #4db1e8; --warn: #f0b45a;
    --page: #171c21; --pass: #12362b; --pass-ink: #8fe0c0; --fail: #43220f; --fail-ink: #ff9a5c;
    --advice: #382b10; --quiet: #93a0ac; --row: #2a333b; --over: #26323c;
  }
}
* { box-sizing: border-box; }
html { background: var(--page); color: var(--ink); font: 15px/1.5 system-ui, "Segoe UI", sans-serif; }
body { max-width: 1640px; margin: 0 auto; padding: 18px 26px 40px; }
h1 { font-size: 25px; line-height: 1.25; margin: 0 0 4px; overflow-wrap: anywhere; }
h2 { font-size: 19px; margin: 0 0 4px; }
p { margin: 0 0 10px; max-width: 130ch; }
section { margin-top: 30px; }
.lead { font-size: 16px; overflow-wrap: anywhere; }
.caption { color: var(--muted); font-size: 14px; margin-top: 6px; overflow-wrap: anywhere; }
.warnings { border-left: 5px solid #e69f00; background: var(--advice); padding: 10px 16px; margin: 12px 0; }
.warnings h2 { font-size: 16px; color: var(--warn); }
.warnings ul { margin: 0; padding-left: 20px; max-height: 210px; overflow: auto; overflow-wrap: anywhere; }
.verdict { border-left: 5px solid #009e73; background: var(--pass); padding: 10px 16px; margin: 12px 0; }
.verdict h2 { font-size: 16px; color: var(--pass-ink); margin: 0; }
.verdict.bad { border-color: var(--fail-ink); background: var(--fail); }
.verdict.bad h2 { color: var(--fail-ink); }
.verdict ul { margin: 4px 0 0; padding-left: 20px; overflow-wrap: anywhere; }
.verdict summary { cursor: pointer; margin-top: 4px; }
.verdict .scroll { margin-top: 8px; background: var(--page); max-height: none; }
.verdict td:nth-child(3) { white-space: normal; min-width: 22em; }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(170px, 1fr)); gap: 12px; }
.figures { margin: 14px 0 0; }
.figures div { background: var(--soft);
  border: 1px solid var(--line); border-radius: 6px; padding: 9px 13px; }
.figures dt { color: var(--muted); font-size: 13px; }
.figures dd { margin: 0; }
.figures .value { font-size: 20px; font-weight: 600; line-height: 1.35; font-variant-numeric: tabular-nums; }
.figures .bad { color: var(--fail-ink); }
.figures .note { color: var(--muted); font-size: 13px; overflow-wrap: anywhere; }
.pair { display: grid; grid-template-columns: minmax(0, 1fr) minmax(0, 1fr); gap: 26px; }
@media (max-width: 1000px) { .pair { grid-template-columns: minmax(0, 1fr); } }
.pair section { min-width: 0; }
.plot { width: 100%; background: #ffffff; border: 1px solid var(--line);
  border-radius: 6px; overflow: hidden; }
#scene { height: 600px; }
#map, #histogram { height: 540px; }
#corrections { height: 520px; }
.panels { display: grid; grid-template-columns: repeat(auto-fit, minmax(240px, 1fr)); gap: 8px 18px; }
.panels > div { min-width: 0; break-inside: avoid; }
.over-image .modebar { display: none; }
.still { display: none; }
h3 { font-size: 16px; margin: 16px 0 6px; overflow-wrap: anywhere; }
tr.quiet td { color: var(--quiet); }
tr.beaten td { background: var(--fail); color: var(--fail-ink); font-weight: 600; }
.controls { display: flex; flex-wrap: wrap; gap: 8px 18px; align-items: center; margin: 6px 0 8px; }
.controls label { max-width: 100%; }
.controls button { font: inherit; padding: 3px 14px; min-width: 6em; cursor: pointer; }
.controls button[aria-pressed=true] { background: var(--after); color: #ffffff; border-style: inset; }
.controls select { font: inherit; max-width: min(640px, 100%); padding: 3px 6px; }
.scroll { max-height: 440px; overflow: auto; border: 1px solid var(--line); border-radius: 6px; }
table { border-collapse: collapse; width: 100%; font-size: 13.5px; font-variant-numeric: tabular-nums; }
th, td { padding: 4px 9px; white-space: nowrap; }
th { position: sticky; top: 0; background: var(--soft); box-shadow: inset 0 -1px 0 var(--line); }
th button { font: inherit; font-size: 13px; font-weight: 600; color: inherit; cursor: pointer; }
th button { background: none; border: 0; padding: 2px 0; }
th button::after { content: " ↕"; color: #9aa5b1; }
th[aria-sort=ascending] button::after { content: " ↑"; color: var(--after); }
th[aria-sort=descending] button::after { content: " ↓"; color: var(--after); }
td { border-top: 1px solid var(--row); }
.text { text-align: left; }
.number { text-align: right; }
tbody tr:hover { background: var(--over); }
.notes li { max-width: 130ch; margin-bottom: 4px; }
.failed { color: var(--fail-ink); padding: 14px; }
code { font-size: 14px; }
@media (min-width: 601px) { .figures div:first-child { grid-column: span 2; } }
@media (max-width: 600px) {
  body { padding: 12px 12px 30px; }
  .figures { grid-template-columns: minmax(0, 1fr); gap: 8px; }
  #scene, #map, #histogram, #corrections { height: 430px; }
  th button { padding: 8px 0; }
  .controls select, .controls button, .verdict summary { min-height: 40px; }
}
@media print {
  /* Paper has no scroll bars and no buttons: tables are whole, with all columns. */
  .scroll, .warnings ul { max-height: none; overflow: visible; }
  table { font-size: 9px; }
  th, td { padding: 2px 4px; white-space: normal; overflow-wrap: anywhere; }
  th { position: static; }
  th button { font-size: 9px; text-align: inherit; }
  th button::after { content: none !important; }
  .panels { grid-template-columns: repeat(2, minmax(0, 1fr)); }
  tr, .plot, .figures div { break-inside: avoid; }
  h2, .controls { break-after: avoid; }
  .modebar, .controls span:not([id]) { display: none !important; }
  /* What WebGL draws does not reach paper: a picture of it does. */
  .plot:has(+ .still) { display: none; }
  .still { display: block; max-width: 100%; break-inside: avoid; }
}
"""
