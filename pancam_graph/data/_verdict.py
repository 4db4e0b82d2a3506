"""The verdict on a solution: tests that say whether its numbers can be believed."""

import math
from dataclasses import dataclass

__all__ = ["Verdict", "VerdictTest"]


@dataclass(frozen=True, kw_only=True)
class VerdictTest:
    """One test of a solution."""

    name: str
    """Short name, the same for every solution."""
    value: float | None
    """Number that was tested; None where there is nothing that the test could look at."""
    limit: float
    """Largest value with which the test passes."""
    passed: bool
    says: str
    """What was found, in a sentence; of a failure also what is likely wrong, and what would tell."""

    @staticmethod
    def of(name: str, value: float | None, limit: float, good: str, bad: str) -> "VerdictTest":
        """A test that says `good` up to its limit, and fails with `bad` beyond it.

        It fails too where the value is no finite number, which is then None.
        """
        passed = value is None or bool(value <= limit)
        number = None if value is None or not math.isfinite(value) else float(value)
        return VerdictTest(
            name=name, value=number, limit=float(limit), passed=passed, says=good if passed else bad
        )

    @staticmethod
    def note(name: str, value: float, limit: float, good: str, advice: str) -> "VerdictTest":
        """A test that never fails: it says `good` up to its limit, and `advice` beyond it."""
        says = good if value <= limit else advice
        return VerdictTest(name=name, value=float(value), limit=float(limit), passed=True, says=says)

    @property
    def is_note(self) -> bool:
        """Whether the test exceeds its limit and passes all the same: what it says is advice."""
        return self.passed and self.value is not None and not self.value <= self.limit


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """All tests of a solution, in the order in which people should read them."""

    tests: tuple[VerdictTest, ...]

    @property
    def passed(self) -> bool:
        """Whether every test passed."""
        return all(test.passed for test in self.tests)

    @property
    def failures(self) -> tuple[VerdictTest, ...]:
        """Tests that failed."""
        return tuple(test for test in self.tests if not test.passed)

    @property
    def notes(self) -> tuple[VerdictTest, ...]:
        """Tests that passed with advice."""
        return tuple(test for test in self.tests if test.is_note)
