"""Custom GTSAM factors: pure residuals with analytic Jacobians, and thin makers.

One module a factor: `mast` (pan-tilt chain, 6 rows), `mast_projection` (a point seen from a rigid mast, 2
rows), `camera_projection` (a point seen by a camera that is no pinhole, 2 rows), `circle` (thesis eq. 4.8, 3
rows), `projective` (projection matrix, 12 rows), `joint_prior` (vectors with correlated errors), `encoder`
(angles and their readings), `stop_position`, `stop_distance`, `stop_heading` (what is known of masts),
`seen` (what lies in a known direction or at a known place, at a pixel, 2 rows).
Factors that GTSAM has (priors of one variable, relative poses, projections of a pinhole) are taken from
GTSAM.
"""

from pancam_graph.factors._slots import Corrected as Corrected
from pancam_graph.factors._slots import Fixed as Fixed
from pancam_graph.factors._slots import Key as Key
from pancam_graph.factors._slots import PoseSlot as PoseSlot
from pancam_graph.factors._slots import Slot as Slot
from pancam_graph.factors.camera_projection import camera_projection_factor as camera_projection_factor
from pancam_graph.factors.camera_projection import camera_projection_residual as camera_projection_residual
from pancam_graph.factors.circle import CircleOffset as CircleOffset
from pancam_graph.factors.circle import circle_factor as circle_factor
from pancam_graph.factors.circle import circle_residual as circle_residual
from pancam_graph.factors.encoder import encoder_factor as encoder_factor
from pancam_graph.factors.encoder import encoder_residual as encoder_residual
from pancam_graph.factors.joint_prior import conditional_prior_factor as conditional_prior_factor
from pancam_graph.factors.joint_prior import conditional_prior_residual as conditional_prior_residual
from pancam_graph.factors.joint_prior import joint_prior_factor as joint_prior_factor
from pancam_graph.factors.joint_prior import joint_prior_residual as joint_prior_residual
from pancam_graph.factors.landmark_blocks import LandmarkBlocks as LandmarkBlocks
from pancam_graph.factors.mast import mast_factor as mast_factor
from pancam_graph.factors.mast import mast_residual as mast_residual
from pancam_graph.factors.mast_projection import mast_projection_factor as mast_projection_factor
from pancam_graph.factors.mast_projection import mast_projection_residual as mast_projection_residual
from pancam_graph.factors.projective import projective_factor as projective_factor
from pancam_graph.factors.projective import projective_residual as projective_residual
from pancam_graph.factors.seen import Seen as Seen
from pancam_graph.factors.seen import SeenDirection as SeenDirection
from pancam_graph.factors.seen import SeenPixel as SeenPixel
from pancam_graph.factors.seen import SeenPlace as SeenPlace
from pancam_graph.factors.seen import camera_seen_factor as camera_seen_factor
from pancam_graph.factors.seen import mast_seen_factor as mast_seen_factor
from pancam_graph.factors.stop_distance import stop_distance_factor as stop_distance_factor
from pancam_graph.factors.stop_distance import stop_distance_residual as stop_distance_residual
from pancam_graph.factors.stop_heading import stop_heading_factor as stop_heading_factor
from pancam_graph.factors.stop_heading import stop_heading_residual as stop_heading_residual
from pancam_graph.factors.stop_position import stop_position_factor as stop_position_factor
from pancam_graph.factors.stop_position import stop_position_residual as stop_position_residual
