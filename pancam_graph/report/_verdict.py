"""The verdict at the top of the page: whether the numbers can be believed, and every test."""

from html import escape

from pancam_graph.data import Verdict, VerdictTest
from pancam_graph.report._numbers import short
from pancam_graph.report._tables import table

__all__ = ["verdict_section"]

_COLUMNS = (
    ("test", "name of the test"),
    ("outcome", "advice: passed, with something to consider"),
    ("what it says", "what was found"),
    ("value", "what was tested; a dash where there was nothing to test"),
    ("limit", "up to which it passes, or gives no advice"),
)


def verdict_section(verdict: Verdict | None) -> str:
    """The verdict as HTML: failures and advice in full, all tests to unfold; nothing without a verdict."""
    if verdict is None:
        return ""
    failed, total = len(verdict.failures), len(verdict.tests)
    head = (
        f"Passed all {total} tests: the numbers can be believed as far as these tell"
        if verdict.passed
        else f"Failed {failed} of {total} tests: do not rely on these numbers before this is settled"
    )
    said = "".join(f"<li>{escape(f'{t.name}: {t.says}')}</li>" for t in (*verdict.failures, *verdict.notes))
    tests = table("Tests of the solution", _COLUMNS, [_row(test) for test in verdict.tests], texts=3)
    points = f"<ul>{said}</ul>\n" if said else ""
    return (
        f'<div class="verdict{"" if verdict.passed else " bad"}" role="note">\n<h2>{escape(head)}</h2>\n'
        f"{points}<details><summary>All tests</summary>\n{tests}</details>\n</div>\n"
    )


def _row(test: VerdictTest) -> tuple[str, ...]:
    outcome = "failed" if not test.passed else "advice" if test.is_note else "passed"
    value = float("nan") if test.value is None else test.value
    return test.name, outcome, test.says, short(value), short(test.limit)
