"""What the search for observations in images found, what it threw away, and why."""

from dataclasses import dataclass
from enum import IntEnum

__all__ = ["Matching", "PairMatching", "Refusal", "StopMatching"]


class Refusal(IntEnum):
    """Why a pair of images, or of stops, gives nothing."""

    NONE = 0
    """It gives something."""
    FEW_ALIKE = 1
    """Too few features look alike where telemetry leaves a place for them."""
    CHANCE = 2
    """No more agree about the geometry than chance would give."""
    FEW_GUIDED = 3
    """Too few look alike where the corrected geometry leaves a place for them."""
    FEW_ON_LINES = 4
    """Too few lie on their epipolar lines, or where the corrected pose has them."""

    @property
    def text(self) -> str:
        """In words, to follow a colon; empty for none."""
        return _TEXTS[self]


_TEXTS = {
    Refusal.NONE: "",
    Refusal.FEW_ALIKE: "too few look alike",
    Refusal.CHANCE: "no more agree than by chance",
    Refusal.FEW_GUIDED: "too few look alike under the corrected geometry",
    Refusal.FEW_ON_LINES: "too few fit the corrected geometry",
}


@dataclass(frozen=True, kw_only=True)
class PairMatching:
    """Features of two images that overlap by pointing. Candidates are kept, or refused for a reason."""

    a: int
    """Row of image a."""
    b: int
    """Row of image b."""
    candidates: int
    """Features of a with a best counterpart in b, in the last search that was made."""
    rover: int
    """Of these, how many stand still relative to the mast between two stops."""
    off_line: int
    """How many are off their epipolar lines under the known rig's geometry, corrected."""
    kept: int
    """The others; 0 where the pair was refused as a whole."""
    refusal: Refusal = Refusal.NONE


@dataclass(frozen=True, kw_only=True)
class StopMatching:
    """Patches of the terrain of one stop, sought in the images of another. Kept, or not for a reason."""

    a: int
    """Row of the stop that places the terrain."""
    b: int
    """Row of the stop whose images are searched."""
    sought: int
    """Patches, each counted once for every image that may show it."""
    unlike: int
    """Found nowhere with enough correlation: hidden, in shadow, or seen too differently."""
    ambiguous: int
    """As like at another place."""
    unstable: int
    """Not confirmed: moved away from where they were found, or back to another place than they came from."""
    masked: int
    """Found where a mask leaves out the image."""
    off_pose: int
    """Not where the pose that most others agree on has them."""
    kept: int
    noise_px: float
    """Of a coordinate of those kept, measured from their scatter; 0 where nothing is kept."""
    refusal: Refusal = Refusal.NONE


@dataclass(frozen=True, kw_only=True)
class Matching:
    """By pairs of images and by pairs of stops, the latter once for each direction."""

    pairs: tuple[PairMatching, ...] = ()
    stops: tuple[StopMatching, ...] = ()

    def summary(self) -> tuple[str, ...]:
        """A line for each step: how much was looked at, how much was kept, and why not the rest."""
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
            # Those that were found, of a pair of stops that is refused as a whole.
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
