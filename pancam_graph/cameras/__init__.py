"""Camera models: pinhole, Brown, CAHV, CAHVOR, CAHVORE, and projection matrices."""

from pancam_graph.cameras._brown import Brown as Brown
from pancam_graph.cameras._cahv import CAHV as CAHV
from pancam_graph.cameras._cahvor import CAHVOR as CAHVOR
from pancam_graph.cameras._cahvore import CAHVORE as CAHVORE
from pancam_graph.cameras._camera import Camera as Camera
from pancam_graph.cameras._camera import Pinhole as Pinhole
from pancam_graph.cameras._camera import Rays as Rays
from pancam_graph.cameras._carry import carry_to_pinhole as carry_to_pinhole
from pancam_graph.cameras._conditioning import Conditioning as Conditioning
from pancam_graph.cameras._lens import MOUNT as MOUNT
from pancam_graph.cameras._lens import Lens as Lens
from pancam_graph.cameras._lens import LensField as LensField
from pancam_graph.cameras._lenses import LENSES as LENSES
from pancam_graph.cameras._lenses import as_cahv as as_cahv
from pancam_graph.cameras._lenses import cahv_of_vectors as cahv_of_vectors
from pancam_graph.cameras._lenses import lens_of as lens_of
from pancam_graph.cameras._matrix import CALIBRATION_ENTRIES as CALIBRATION_ENTRIES
from pancam_graph.cameras._matrix import decompose_projection as decompose_projection
from pancam_graph.cameras._matrix import projection_matrix as projection_matrix
from pancam_graph.cameras._matrix import projection_tangents as projection_tangents
from pancam_graph.cameras._matrix import split_projections as split_projections
from pancam_graph.cameras._straighten import straight_pixels as straight_pixels
from pancam_graph.cameras._straighten import straightened as straightened
from pancam_graph.cameras._straighten import straightening_map as straightening_map
