"""The same as `pancam-graph render`, with the same options; for a checkout."""

import needs_package  # noqa: F401  it ends the script where there is no package
from pancam_graph.cli import run_script

if __name__ == "__main__":
    run_script("render")
