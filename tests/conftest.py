"""Fixtures that several test modules share."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def opportunity_folder() -> Path:
    """Five left Navcam images of Opportunity, sol 4087; not in the repository.

    Looked for in the folder that PANCAM_GRAPH_DATA names, then in ../shared/data beside the repository.
    """
    name = "opportunity_navcam_sol4087"
    named = os.environ.get("PANCAM_GRAPH_DATA")
    roots = [Path(named)] if named else []
    roots.append(Path(__file__).resolve().parents[1].parent / "shared" / "data")
    for root in roots:
        if (root / name).is_dir():
            return root / name
    pytest.skip(f"no folder {name} in {' or '.join(str(r) for r in roots)}; set PANCAM_GRAPH_DATA")
