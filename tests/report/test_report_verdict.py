"""The verdict on the page: first what failed, in words; every test to unfold."""

from dataclasses import replace

from pancam_graph.data import Solution, Verdict, VerdictTest
from pancam_graph.report._page import headline, make_page
from support.report_pages import Structure

GOOD = VerdictTest(name="noise", value=1.0, limit=1.5, passed=True, says="residuals are as stated")
ADVICE = VerdictTest(name="held rig", value=90.0, limit=25.0, passed=True, says="freeing <cx> would help")
BAD = VerdictTest(name="pointing", value=8.0, limit=4.5, passed=False, says="pan of f<1> moved")


def page_of(solution: Solution, *tests: VerdictTest) -> str:
    page = make_page(replace(solution, verdict=Verdict(tests=tests)))
    structure = Structure()
    structure.feed(page)
    assert structure.open == []
    return page


def test_a_failure_stands_on_top_and_in_the_headline(solution: Solution) -> None:
    page = page_of(solution, GOOD, ADVICE, BAD)
    top = page[: page.index("All tests")]
    assert "Failed 1 of 3 tests" in top
    assert "pointing: pan of f&lt;1&gt; moved" in top
    assert "held rig: freeing &lt;cx&gt; would help" in top
    assert page.index("Failed 1 of 3 tests") < page.index('<dl class="figures">')
    judged = headline(replace(solution, verdict=Verdict(tests=(BAD,))))
    assert ("converged, failed its tests", True) in [(value, bad) for _, value, _, bad in judged]


def test_a_solution_that_passed_says_so(solution: Solution) -> None:
    page = page_of(solution, GOOD, ADVICE)
    assert "Passed all 2 tests" in page
    assert "Failed" not in page[: page.index("All tests")]
    assert page.count('<td class="text">advice</td>') == 1


def test_a_page_without_a_verdict_has_no_such_section(solution: Solution) -> None:
    assert 'class="verdict' not in make_page(replace(solution, verdict=None))
