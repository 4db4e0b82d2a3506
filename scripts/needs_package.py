"""Ends a script with a sentence where it runs outside the environment that has the package."""

import sys
from importlib.util import find_spec

if find_spec("pancam_graph") is None:
    sys.stderr.write(
        f"pancam_graph is not installed for {sys.executable}: run `. .venv/bin/activate` first; where there "
        "is no .venv, `bash scripts/demo.sh` makes it\n"
    )
    sys.exit(2)
