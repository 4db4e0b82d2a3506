"""Statistics of the search for observations in images: matches kept, matches refused, and why."""

from dataclasses import dataclass
from enum import IntEnum

__all__ = ["Matching", "PairMatching", "Refusal", "StopMatching"]


class Refusal(IntEnum):
    """Reason why a pair of images, or of stops, yields no matches."""

    NONE = 0
    """The pair yields matches."""
    FEW_ALIKE = 1
    """Too few features look alike where telemetry leaves a place for them."""
    CHANCE = 2
    """Matches that agree about the geometry are no more than chance explains."""
    FEW_GUIDED = 3
    """Too few look alike where the corrected geometry leaves a place for them."""
    FEW_ON_LINES = 4
    """Too few lie on their epipolar lines, or where the corrected pose has them."""
    CONTRADICTION = 5
    """The terrain of either stop, sought in the other's images, says another pose between the two."""

    @property
    def text(self) -> str:
        """The reason in words, to stand after a colon; empty for NONE."""
        return _TEXTS[self]


_TEXTS = {
    Refusal.NONE: "",
    Refusal.FEW_ALIKE: "too few look alike",
    Refusal.CHANCE: "no more agree than by chance",
    Refusal.FEW_GUIDED: "too few look alike under the corrected geometry",
    Refusal.FEW_ON_LINES: "too few fit the corrected geometry",
    Refusal.CONTRADICTION: "the two directions contradict each other",
}


@dataclass(frozen=True, kw_only=True)
class PairMatching:
    """Match statistics of two images that overlap by their pointing."""

    a: int
    """Row of image a."""
    b: int
    """Row of image b."""
    candidates: int
    """Features of image a with a best counterpart in image b, in the last search."""
    rover: int
    """Candidates that do not move relative to the mast between two stops, as the rover's own body."""
    off_line: int
    """Candidates too far from their epipolar lines under the corrected geometry."""
    kept: int
    """Candidates that are kept; 0 if the pair was refused as a whole."""
    refusal: Refusal = Refusal.NONE


@dataclass(frozen=True, kw_only=True)
class StopMatching:
    """Statistics of terrain patches of one stop that are sought in the images of another."""

    a: int
    """Row of the stop that places the terrain."""
    b: int
    """Row of the stop whose images are searched."""
    sought: int
    """Patches sought, counted once for every image that may show them."""
    unlike: int
    """Patches without a place of sufficient correlation: hidden, in shadow, or seen too differently."""
    ambiguous: int
    """Patches that correlate as well at a second place."""
    unstable: int
    """Patches whose refinement left the place of best correlation, or whose search back missed their
    origin."""
    masked: int
    """Patches located on masked pixels."""
    off_pose: int
    """Patches that contradict the pose on which most others agree."""
    kept: int
    """Patches that are kept."""
    noise_px: float
    """Standard deviation of a coordinate of kept patches, measured from their scatter; 0 if none is kept."""
    refusal: Refusal = Refusal.NONE


@dataclass(frozen=True, kw_only=True)
class Matching:
    """Statistics of matching, by pairs of images and by ordered pairs of stops."""

    pairs: tuple[PairMatching, ...] = ()
    stops: tuple[StopMatching, ...] = ()

    def summary(self) -> tuple[str, ...]:
        """One line for each step: how much was examined, how much kept, and why the rest was not."""
        lines = []
        if self.pairs:
            refused = _counted({r.text: sum(p.refusal == r for p in self.pairs) for r in Refusal if r})
            whole = [p for p in self.pairs if not p.refusal]
            lines.append(f"pairs of images: {len(whole)} of {len(self.pairs)} matched{refused}")
            why = {
                "off their epipolar lines": sum(p.off_line for p in whole),
                "standing still relative to the mast": sum(p.rover for p in whole),
            }
            kept, candidates = sum(p.kept for p in whole), sum(p.candidates for p in whole)
            lines.append(f"their matches: {kept} of {candidates} kept{_counted(why)}")
        if self.stops:
            why = {name: sum(getattr(s, field) for s in self.stops) for name, field in _PATCHES.items()}
            # Patches that were located, but whose pair of stops was refused as a whole.
            sought, kept = sum(s.sought for s in self.stops), sum(s.kept for s in self.stops)
            why["of stops that were refused"] = sought - kept - sum(why.values())
            lines.append(f"patches between stops: {kept} of {sought} kept{_counted(why)}")
        return tuple(lines)


def _counted(why: dict[str, int]) -> str:
    texts = [f"{count} {text}" for text, count in why.items() if count]
    return f"; {', '.join(texts)}" if texts else ""


_PATCHES = {
    "unlike": "unlike",
    "ambiguous": "ambiguous",
    "unstable": "unstable",
    "masked": "masked",
    "off the common pose": "off_pose",
}
