"""From image files to observations: reading, features, matching, tracks."""

from pancam_graph.images._cache_folder import CACHE as CACHE
from pancam_graph.images._cache_folder import cache_folder as cache_folder
from pancam_graph.images._cache_folder import is_cache as is_cache
from pancam_graph.images._front_end import find_masks as find_masks
from pancam_graph.images._front_end import find_observations as find_observations
from pancam_graph.images._front_end_options import FrontEndOptions as FrontEndOptions
from pancam_graph.images._masks import ImageMask as ImageMask
from pancam_graph.images._masks import Reason as Reason
from pancam_graph.images._normalise import usable_mask as usable_mask
