"""`python -m pancam_graph` is the command `pancam-graph`."""

from pancam_graph.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
