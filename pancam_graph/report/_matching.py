"""The section on matching: how many matches were refused, and why."""

from pancam_graph.data import Matching, Traverse
from pancam_graph.report._escaped import escape
from pancam_graph.report._numbers import fixed
from pancam_graph.report._tables import table

__all__ = ["matching_section"]

_PAIR_CAPTION = (
    "Pairs of images that overlap by pointing. Candidates are features that are each other's best where "
    "the geometry leaves a place for them; refused are those off their epipolar lines under the rig's "
    "geometry, corrected by what most of the pair's say, and between stops those that stand still relative "
    "to the mast. A pair that is refused as a whole gives nothing."
)
_STOP_CAPTION = (
    "Patches of the terrain that one stop places, sought in the images of another, one row for each "
    "direction. Each patch counts once for every image that may show it. The noise is that of a coordinate "
    "of those kept, measured from their scatter about the pose that most agree on."
)


def matching_section(traverse: Traverse) -> str:
    """The section as HTML; nothing for observations from elsewhere."""
    matching = traverse.matching
    if matching is None:
        return ""
    notes = "".join(f"<li>{escape(line)}</li>" for line in matching.summary())
    between = _stop_table(matching, traverse) + _caption(_STOP_CAPTION) if matching.stops else ""
    return (
        f'<section>\n<h2>Matching</h2>\n<ul class="notes">{notes}</ul>\n{between}'
        f"{_pair_table(matching, traverse)}{_caption(_PAIR_CAPTION)}</section>"
    )


def _caption(text: str) -> str:
    return f'\n<p class="caption">{escape(text)}</p>\n'


def _pair_table(matching: Matching, traverse: Traverse) -> str:
    columns = (
        ("image", "id of the first image"),
        ("image", "id of the second image"),
        ("refused as a whole", "why the pair gives nothing"),
        ("candidates", "matches by looks, in the last search"),
        ("kept", "matches that the geometry confirms"),
        ("off line", "refused: off their epipolar lines"),
        ("rover", "refused: they stand still relative to the mast"),
    )
    rows = [
        (
            traverse.images[p.a].id,
            traverse.images[p.b].id,
            p.refusal.text,
            *(str(n) for n in (p.candidates, p.kept, p.off_line, p.rover)),
        )
        for p in matching.pairs
    ]
    return table("Pairs of images", columns, rows, texts=3)


def _stop_table(matching: Matching, traverse: Traverse) -> str:
    columns = (
        ("terrain of", "id of the stop that places the terrain"),
        ("in images of", "id of the stop whose images are searched"),
        ("refused as a whole", "why the pair gives nothing"),
        ("sought", "patches that the images may show"),
        ("kept", "found where the others agree that they should be"),
        ("unlike", "found nowhere: hidden, in shadow, or seen too differently"),
        ("ambiguous", "as like at another place"),
        ("unstable", "not confirmed by the fit, or not found back where they came from"),
        ("masked", "found where a mask leaves out the image"),
        ("off pose", "not where the others agree that they should be"),
        ("noise (px)", "of each coordinate of those kept"),
    )
    rows = [
        (
            traverse.stops[s.a].id,
            traverse.stops[s.b].id,
            s.refusal.text,
            *(str(n) for n in (s.sought, s.kept, s.unlike, s.ambiguous, s.unstable, s.masked, s.off_pose)),
            fixed(s.noise_px, 3) if s.kept else "",
        )
        for s in matching.stops
    ]
    return table("Pairs of stops", columns, rows, texts=3)
