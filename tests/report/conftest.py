"""Fixtures of the report's tests."""

import pytest

from pancam_graph.data import Solution
from pancam_graph.report._page import make_page
from support.made_solutions import fabricate


@pytest.fixture(scope="module")
def solution() -> Solution:
    return fabricate()


@pytest.fixture(scope="module")
def page(solution: Solution) -> str:
    return make_page(solution)
