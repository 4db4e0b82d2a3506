"""From image files to observations: reading, features, matching, tracks.

All but the folder of the cache is imported when it is asked for: a solve of observations needs no OpenCV.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from pancam_graph.images._cache_folder import CACHE as CACHE
from pancam_graph.images._cache_folder import cache_folder as cache_folder
from pancam_graph.images._cache_folder import is_cache as is_cache

if TYPE_CHECKING:
    from pancam_graph.images._cache import Arrays as Arrays
    from pancam_graph.images._cache import Cache as Cache
    from pancam_graph.images._cache import key_of as key_of
    from pancam_graph.images._evening import Evening as Evening
    from pancam_graph.images._evening import Small as Small
    from pancam_graph.images._evening import even_out as even_out
    from pancam_graph.images._front_end import Masks as Masks
    from pancam_graph.images._front_end import find_masks as find_masks
    from pancam_graph.images._front_end import find_observations as find_observations
    from pancam_graph.images._front_end_options import FrontEndOptions as FrontEndOptions
    from pancam_graph.images._masks import ImageMask as ImageMask
    from pancam_graph.images._masks import Reason as Reason
    from pancam_graph.images._normalise import usable_mask as usable_mask
    from pancam_graph.images._on_workers import crew_at_work as crew_at_work
    from pancam_graph.images._read import for_workers as for_workers
    from pancam_graph.images.pointing import FoundPointing as FoundPointing
    from pancam_graph.images.pointing import find_pointing as find_pointing
else:
    _LATE = {
        "Arrays": "_cache",
        "Cache": "_cache",
        "key_of": "_cache",
        "Evening": "_evening",
        "Small": "_evening",
        "even_out": "_evening",
        "Masks": "_front_end",
        "find_masks": "_front_end",
        "find_observations": "_front_end",
        "FrontEndOptions": "_front_end_options",
        "ImageMask": "_masks",
        "Reason": "_masks",
        "usable_mask": "_normalise",
        "crew_at_work": "_on_workers",
        "for_workers": "_read",
        "FoundPointing": "pointing",
        "find_pointing": "pointing",
    }

    def __getattr__(name: str) -> object:
        if name not in _LATE:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = globals()[name] = getattr(import_module(f"{__name__}.{_LATE[name]}"), name)
        return value
