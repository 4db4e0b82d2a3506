"""The script of the page: unpacks Plotly and the figures, draws, and sorts tables."""

from pancam_graph.report._packed import UNPACKED

__all__ = ["SCRIPT"]

SCRIPT = (
    r"""
"use strict";
// Nothing leaves this page: Plotly's button that uploads a chart is taken away.
const config = { displaylogo: false, responsive: true, showSendToCloud: false, plotlyServerURL: "",
  modeBarButtonsToRemove: ["sendChartToCloud", "select2d", "lasso2d", "resetCameraLastSave3d"] };

"""
    + UNPACKED
    + r"""

function filled(select, names) {
  names.forEach((name, row) => select.add(new Option(name, String(row))));
  return select;
}

// On a phone legends lie below their figures, where they hide nothing.
function fitted(layout, width) {
  if (width >= 600 || !layout.legend || layout.legend.y < 0) return layout;
  const margin = { ...layout.margin };
  margin.b += 62;
  return { ...layout, margin, legend: { ...layout.legend, orientation: "h", x: 0, xanchor: "left", y: 0,
    yanchor: "bottom", yref: "container" } };
}

// A picture of the scene, for paper.
async function drawStill() {
  const scene = document.getElementById("scene");
  const picture = await Plotly.toImage(scene, { format: "png", width: 1100, height: 620 });
  let still = scene.parentElement.querySelector(".still");
  if (!still) {
    still = document.createElement("img");
    still.className = "still";
    still.alt = "The scene, as chosen on the screen";
    scene.after(still);
  }
  still.src = picture;
}

// Paper is narrower than a screen; figures are drawn again for it, and then for the screen once more.
const PAPER_PX = 700;
function fitToPaper() {
  document.querySelectorAll(".js-plotly-plot:not(#scene)").forEach((place) => {
    const width = Math.min(PAPER_PX, place.clientWidth);
    place.dataset.height = place.style.height;
    const height = Math.round(place.clientHeight * Math.sqrt(width / place.clientWidth));
    place.style.height = `${height}px`;
    Plotly.relayout(place, { width, height });
  });
}
function fitToScreen() {
  document.querySelectorAll(".js-plotly-plot:not(#scene)").forEach((place) => {
    place.style.height = place.dataset.height;
    Plotly.relayout(place, { width: null, height: null, autosize: true });
  });
}
addEventListener("beforeprint", fitToPaper);
addEventListener("afterprint", fitToScreen);

function drawScene(page) {
  const scene = page.figures.find((figure) => figure.id === "scene");
  const roles = scene.data.map((trace) => trace.meta);
  const labels = structuredClone(scene.layout.scene.annotations);
  const select = filled(document.getElementById("scene-view"), page.views.map((view) => view.name));
  select.addEventListener("change", () => {
    const view = page.views[Number(select.value)];
    const hidden = view.true_size ? "far" : "near";
    // Close to one mast its name would only hide it.
    const layout = { "scene.aspectratio": view.ratio, "scene.annotations": view.true_size ? [] : labels };
    ["x", "y", "z"].forEach((name, i) => {
      layout[`scene.${name}axis.range`] = view.range[i];
      layout[`scene.${name}axis.nticks`] = view.ticks[i];
    });
    Plotly.update("scene", { visible: roles.map((role) => role !== hidden) }, layout).then(drawStill);
  });
}

function vectorTraces(image, side, factor, wanted, name, colour, legend) {
  const [du, dv] = image[side];
  const axes = side === "before" ? { xaxis: "x", yaxis: "y" } : { xaxis: "x2", yaxis: "y2" };
  const line = { x: [], y: [] }, foot = { x: [], y: [], text: [] };
  image.u.forEach((u, i) => {
    if (image.used[i] !== wanted) return;
    const v = image.v[i];
    foot.x.push(u);
    foot.y.push(v);
    if (du[i] === null || dv[i] === null) {
      foot.text.push("residual not defined");
      return;
    }
    foot.text.push(`${Math.hypot(du[i], dv[i]).toPrecision(3)} px (${du[i]}, ${dv[i]})`);
    line.x.push(u, u + factor * du[i], null);
    line.y.push(v, v + factor * dv[i], null);
  });
  const shared = { ...axes, type: "scatter", legendgroup: name };
  return [
    { ...shared, mode: "lines", ...line, line: { color: colour, width: wanted ? 1.6 : 0.8 },
      hoverinfo: "skip", showlegend: false },
    { ...shared, mode: "markers", ...foot, marker: { color: colour, size: 3.5 }, name, showlegend: legend,
      hovertemplate: "pixel (%{x}, %{y})<br>%{text}<extra></extra>" },
  ];
}

function drawVectors(page) {
  const select = document.getElementById("vectors-image");
  if (!select) return;
  filled(select, page.vectors.map((image) => image.label));
  const scale = document.getElementById("vectors-scale");
  const base = page.figures.find((figure) => figure.id === "vectors").layout;
  const note = document.getElementById("vectors-note");
  const show = () => {
    const image = page.vectors[Number(select.value)];
    const factors = scale.value === "same" ? [image.factor[0], image.factor[0]] : image.factor;
    const data = ["before", "after"].flatMap((side, i) => [
      ...vectorTraces(image, side, factors[i], 1, "used", page.colours.used, i === 0),
      ...vectorTraces(image, side, factors[i], 0, "rejected", page.colours.rejected, i === 0),
    ]);
    const layout = structuredClone(base);
    const [xRange, yRange] = [[-0.5, image.width - 0.5], [image.height - 0.5, -0.5]];
    ["", "2"].forEach((n) => {
      layout[`xaxis${n}`].range = xRange;
      layout[`yaxis${n}`].range = yRange;
    });
    layout.shapes = ["", "2"].map((n) => ({ type: "rect", xref: `x${n}`, yref: `y${n}`, layer: "below",
      x0: xRange[0], x1: xRange[1], y0: yRange[1], y1: yRange[0],
      line: { color: page.colours.frame, width: 1 } }));
    layout.images = image.picture === null ? [] : ["", "2"].map((n) => ({ source: image.picture,
      xref: `x${n}`, yref: `y${n}`, x: -0.5, y: -0.5, sizex: image.width, sizey: image.height,
      xanchor: "left", yanchor: "top", sizing: "stretch", layer: "below" }));
    const place = document.getElementById("vectors");
    const narrow = place.clientWidth < 900;  // where a title has no room in one line
    if (narrow) layout.margin = { ...layout.margin, t: 70 };
    layout.annotations = ["before", "after"].map((side, i) => ({
      text: `<b>${side}</b>${narrow ? "<br>" : ", vectors "}${
        factors[i] === 1 ? "at true length" : `${factors[i].toLocaleString("en")} times enlarged`}`,
      align: "left",
      xref: `x${i ? "2" : ""} domain`, yref: "paper", x: 0, y: 1.005, xanchor: "left", yanchor: "bottom",
      showarrow: false }));
    note.textContent = (image.shown < image.total
      ? `${image.shown} of the ${image.total} observations are drawn. ` : "") +
      (image.picture === null ? "There is no picture of this image, so its frame is empty." : "");
    // As high as two panels side by side need, for any shape of image.
    const high = 0.485 * (place.clientWidth - 75) * image.height / image.width + (narrow ? 160 : 135);
    place.style.height = `${Math.round(Math.min(Math.max(high, 300), 860))}px`;
    Plotly.react(place, data, layout, config);
    Plotly.Plots.resize(place);
  };
  select.addEventListener("change", show);
  scale.addEventListener("change", show);
  show();
}

function sortTable(table, column, head) {
  const falling = head.getAttribute("aria-sort") === "ascending";
  table.querySelectorAll("th").forEach((other) => other.removeAttribute("aria-sort"));
  head.setAttribute("aria-sort", falling ? "descending" : "ascending");
  const numeric = head.classList.contains("number");
  const key = (row) => {
    const text = row.cells[column].textContent;
    if (!numeric) return text;
    const number = parseFloat(text);
    return Number.isNaN(number) ? (falling ? -Infinity : Infinity) : number;
  };
  const body = table.tBodies[0];
  const rows = [...body.rows].map((row) => [key(row), row]);
  const order = numeric ? (a, b) => (a[0] === b[0] ? 0 : a[0] - b[0]) : (a, b) => a[0].localeCompare(b[0]);
  rows.sort((a, b) => (falling ? -order(a, b) : order(a, b)));
  body.append(...rows.map((pair) => pair[1]));
}

document.querySelectorAll("table.sortable").forEach((table) => {
  table.querySelectorAll("th").forEach((head, column) => {
    head.querySelector("button").addEventListener("click", () => sortTable(table, column, head));
  });
});

function sayFailed(place, error) {
  const text = document.createElement("p");
  text.className = "failed";
  text.textContent = `This browser could not draw the figure (${error}). A browser of 2023 or later with ` +
    "WebGL is needed; the headline figures and the tables do not depend on it.";
  place.replaceChildren(text);
}

(async () => {
  try {
    const library = document.createElement("script");
    library.textContent = await unpacked("packed-plotly");
    document.head.append(library);
    const page = JSON.parse(await unpacked("packed-figures"));
    for (const { id, data, layout } of page.figures) {
      if (id === "vectors") continue;
      const place = document.getElementById(id);
      await Plotly.newPlot(place, data, fitted(layout, place.clientWidth), config)
        .catch((e) => sayFailed(place, e));
    }
    drawScene(page);
    drawVectors(page);
    await drawStill().catch(() => {});  // a page without WebGL has said so already
    document.documentElement.dataset.drawn = "yes";
  } catch (error) {
    document.querySelectorAll(".plot:empty").forEach((place) => sayFailed(place, error));
  }
})();
"""
)
