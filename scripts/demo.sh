#!/usr/bin/env bash
# The main job on a simulated rover: simulate a panorama with wrong pointing, refine it, say where the report is.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/environment.sh
prepare ""

traverse=out/demo/traverse
if [ ! -e "$traverse/traverse.json" ]; then
    echo "simulating two stops of a MER Navcam panorama: telemetry errors, pixel noise, 3 % outliers"
    .venv/bin/pancam-graph simulate "$traverse" --rig mer-navcam --stops 2 --outliers 0.03 --seed 1
fi
echo "refining it (the first run on a machine compiles the kernel, once: about half a minute more)"
.venv/bin/pancam-graph refine "$traverse" --out out/demo/result
echo "open out/demo/result/report.html in a browser: before beside after"
