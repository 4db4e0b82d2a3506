"""A page that replays a drive: the estimate after every stop, with its ellipses, truth and odometry."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pancam_graph.base.ellipses import ellipse_outlines, translation_covariance_in_world
from pancam_graph.base.geometry import FloatArray, pose_arrays
from pancam_graph.base.whole_files import whole_file
from pancam_graph.report._escaped import escape
from pancam_graph.report._look import AFTER, BEFORE, REJECTED, axis, layout, logarithmic
from pancam_graph.report._numbers import Json, polyline, rounded
from pancam_graph.report._packed import HEAD, UNPACKED, packed, packed_plotly
from pancam_graph.report._style import STYLE
from pancam_graph.simulate import Simulation
from pancam_graph.smoother import TraverseSmoother, Update

__all__ = ["DriveStep", "write_drive"]

_SIGMAS = 3.0
_WANTED = 0.25
"""The largest ellipse is drawn about as large as this share of the distance between stops."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DriveStep:
    """The estimate after a stop."""

    update: Update
    position_m: FloatArray
    """(stops so far, 3) positions of the stops in the world."""
    covariance_m2: FloatArray
    """(stops so far, 3, 3) covariances of the positions, in world axes."""
    driven_m: float
    error_m: float
    """Distance of the newest stop from its true position."""
    odometry_error_m: float
    """The same distance by odometry alone."""

    @staticmethod
    def of(smoother: TraverseSmoother, update: Update, simulation: Simulation) -> "DriveStep":
        """The estimate of a smoother in a simulated drive, all of whose stops it has, in their order."""
        estimate, n = smoother.estimate(), len(smoother.stops)
        rotation, position = pose_arrays(estimate.world_T_mast)
        covariance = np.array([smoother.covariance(stop) for stop in smoother.stops])
        truth = pose_arrays(simulation.truth.world_T_mast[:n])[1]
        said = simulation.telemetry_start.world_T_mast[n - 1].translation()
        return DriveStep(
            update=update,
            position_m=position,
            covariance_m2=translation_covariance_in_world(rotation, covariance),
            driven_m=float(np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()),
            error_m=float(np.linalg.norm(position[-1] - truth[-1])),
            odometry_error_m=float(np.linalg.norm(said - truth[-1])),
        )

    @property
    def summary(self) -> str:
        """Errors as shares of the distance."""
        driven = max(self.driven_m, 1e-9)
        return (
            f"{self.driven_m:.0f} m driven, error {self.error_m:.3f} m "
            f"({100 * self.error_m / driven:.3f} %), "
            f"odometry alone {self.odometry_error_m:.2f} m ({100 * self.odometry_error_m / driven:.2f} %)"
        )


def write_drive(steps: Sequence[DriveStep], simulation: Simulation, path: Path | str) -> None:
    """Write the replay as one self-contained HTML file, whole or not at all; its folder must exist."""
    whole_file(Path(path).resolve(), _page(steps, simulation).encode())


def _page(steps: Sequence[DriveStep], simulation: Simulation) -> str:
    truth = pose_arrays(simulation.truth.world_T_mast)[1]
    said = pose_arrays(simulation.telemetry_start.world_T_mast)[1]
    spread = max(float(np.sqrt(step.covariance_m2[:, :2, :2].max(initial=0.0))) for step in steps)
    spacing = (
        float(np.median(np.linalg.norm(np.diff(truth[:, :2], axis=0), axis=1))) if len(truth) > 1 else 1.0
    )
    enlarged = max(1.0, float(f"{_WANTED * spacing / max(_SIGMAS * spread, 1e-9):.1g}"))
    frames = [_frame(step, said, enlarged, len(truth)) for step in steps]
    first: list[Json] = [
        _trace("truth", truth, mode="lines", line={"color": BEFORE, "width": 5}),
        *frames[-1]["data"],
    ]
    everything = np.vstack([truth, said])[:, :2]
    low, high = everything.min(axis=0), everything.max(axis=0)
    margin = 0.06 * float((high - low).max()) + 1.0
    figure = {
        "data": first,
        "layout": layout(
            xaxis=axis("x, m", range=[low[0] - margin, high[0] + margin]),
            yaxis=axis("y, m", range=[low[1] - margin, high[1] + margin], scaleanchor="x"),
            legend={"orientation": "h", "x": 0, "y": 1.06},
            margin={"l": 60, "r": 20, "t": 46, "b": 50},
            uirevision="drive",
        ),
    }
    errors = {
        "data": [
            {
                "type": "scatter",
                "name": name,
                "x": list(range(2, len(steps) + 1)),
                "y": rounded([getattr(s, what) for s in steps[1:]], 4),
                "mode": "lines+markers",
                "line": {"color": colour},
            }
            for name, what, colour in (
                ("odometry alone", "odometry_error_m", REJECTED),
                ("estimate", "error_m", AFTER),
            )
        ],
        "layout": layout(
            xaxis=axis("stops driven"),
            yaxis=axis(
                "error of the newest stop, m",
                **logarithmic([e for s in steps[1:] for e in (s.odometry_error_m, s.error_m)]),
            ),
            legend={"orientation": "h", "x": 0, "y": 1.08},
            margin={"l": 70, "r": 20, "t": 46, "b": 50},
        ),
    }
    data = {"map": figure, "errors": errors, "frames": frames}
    last = steps[-1]
    loops = [c for step in steps for c in step.update.closures]
    closed = ", ".join(f"{c.stop} sees {c.other} again" for c in loops if c.accepted) or "none"
    return _PAGE.format(
        unpacked=UNPACKED,
        title=escape(f"Drive of {len(steps)} stops, {simulation.traverse.name}"),
        style=STYLE + "\n#map { height: 600px; } #errors { height: 600px; } #at { width: 420px; }",
        lead=escape(f"At the end: {last.summary}. Loop closures: {closed}."),
        caption=escape(
            f"Ellipses: {_SIGMAS:g} sigma of each stop's position, {enlarged:g} times enlarged. The estimate "
            "lies on the truth where its line covers the grey one."
        ),
        n=len(steps),
        plotly=packed_plotly(),
        figures=packed(json.dumps(data, separators=(",", ":"), allow_nan=False)),
    )


def _frame(step: DriveStep, said: FloatArray, enlarged: float, n_all: int) -> Json:
    n = len(step.position_m)
    outlines = ellipse_outlines(step.covariance_m2[:, :2, :2], _SIGMAS * enlarged)
    outlines = outlines + step.position_m[:, None, :2]
    x, y = polyline(outlines, 3)
    u = step.update
    closed = "".join(f"; closes the loop to {c.other}" for c in u.closures if c.accepted)
    return {
        "data": [
            _trace("odometry alone", said[:n], line={"color": REJECTED, "width": 1.5, "dash": "dot"}),
            _trace("estimate", step.position_m, line={"color": AFTER, "width": 2}, marker={"size": 6}),
            {
                "type": "scatter",
                "name": "uncertainty",
                "x": x,
                "y": y,
                "mode": "lines",
                "line": {"color": AFTER, "width": 1},
                "hoverinfo": "skip",
            },
        ],
        "note": f"stop {n} of {n_all}: {step.summary}; {u.seconds:.2f} s, {u.blocks} blocks{closed}",
    }


def _trace(name: str, position_m: FloatArray, **more: object) -> Json:
    x, y = position_m[:, 0], position_m[:, 1]
    return {
        "type": "scatter",
        "name": name,
        "x": rounded(x, 3),
        "y": rounded(y, 3),
        "mode": "lines+markers",
        "marker": {"size": 4},
        **more,
    }


_PAGE = (
    HEAD
    + """</header>
<main>
<div class="controls"><button id="play">Play</button>
<label>Stop <input id="at" type="range" min="1" max="{n}" value="{n}"></label><span id="note"></span></div>
<div class="pair">
<section><h2>Map</h2><div class="plot" id="map" role="group" aria-label="Map"></div>
<p class="caption">{caption}</p></section>
<section><h2>Error against truth</h2>
<div class="plot" id="errors" role="group" aria-label="Error against truth"></div>
<p class="caption">Of the newest stop, after its own update. Where the loop closes, odometry has drifted and
the estimate has not.</p></section>
</div>
</main>
<script type="text/plain" id="packed-plotly">{plotly}</script>
<script type="text/plain" id="packed-figures">{figures}</script>
<script>
"use strict";
{unpacked}
(async () => {{
  (0, eval)(await unpacked("packed-plotly"));
  const page = JSON.parse(await unpacked("packed-figures"));
  const config = {{ displaylogo: false, responsive: true, showSendToCloud: false, plotlyServerURL: "" }};
  const at = document.getElementById("at"), note = document.getElementById("note");
  const truth = page.map.data[0];
  const show = () => {{
    const frame = page.frames[at.value - 1];
    note.textContent = frame.note;
    Plotly.react("map", [truth, ...frame.data], page.map.layout, config);
  }};
  at.addEventListener("input", show);
  let timer = null;
  document.getElementById("play").addEventListener("click", (event) => {{
    if (timer === null && Number(at.value) === page.frames.length) at.value = 1;
    clearInterval(timer);
    timer = timer !== null ? null : setInterval(() => {{
      if (Number(at.value) >= page.frames.length) document.getElementById("play").click();
      else {{ at.value = Number(at.value) + 1; show(); }}
    }}, 500);
    event.target.textContent = timer === null ? "Play" : "Pause";
    show();
  }});
  show();
  Plotly.newPlot("errors", page.errors.data, page.errors.layout, config);
}})();
</script>
</body>
</html>
"""
)
