"""The verdict at the top of the page: whether the numbers can be believed, and every test."""

from html import escape

from pancam_graph.data import Verdict, VerdictTest
from pancam_graph.report._numbers import short

__all__ = ["verdict_section"]

_COLUMNS = (
    ("test", "text"),
    ("value", "number"),
    ("limit", "number"),
    ("outcome", "text"),
    ("what it says", "text"),
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
    points = f"<ul>{said}</ul>\n" if said else ""
    return (
        f'<div class="verdict{"" if verdict.passed else " bad"}" role="note">\n<h2>{escape(head)}</h2>\n'
        f"{points}<details><summary>All tests</summary>\n{_table(verdict)}</details>\n</div>\n"
    )


def _table(verdict: Verdict) -> str:
    head = "".join(f'<th scope="col" class="{kind}">{escape(name)}</th>' for name, kind in _COLUMNS)
    rows = "\n".join(_row(test) for test in verdict.tests)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>\n{rows}\n</tbody></table></div>'


def _row(test: VerdictTest) -> str:
    outcome = "failed" if not test.passed else "advice" if test.is_note else "passed"
    cells = (
        test.name,
        short(float("nan") if test.value is None else test.value),
        short(test.limit),
        outcome,
        test.says,
    )
    return (
        "<tr>"
        + "".join(
            f'<td class="{kind}">{escape(cell)}</td>' for cell, (_, kind) in zip(cells, _COLUMNS, strict=True)
        )
        + "</tr>"
    )
