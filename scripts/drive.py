"""The same as `pancam-graph drive`, with the same options; for a checkout."""

from pancam_graph.cli import run_script

if __name__ == "__main__":
    run_script("drive")
