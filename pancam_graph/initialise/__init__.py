"""First values of what the adjustment estimates: from telemetry, odometry, or given cameras."""

from pancam_graph.initialise._circle import CircleFit as CircleFit
from pancam_graph.initialise._circle import fit_circle as fit_circle
from pancam_graph.initialise._extract import CircleCameras as CircleCameras
from pancam_graph.initialise._extract import FreeCameras as FreeCameras
from pancam_graph.initialise._extract import MastCameras as MastCameras
from pancam_graph.initialise._extract import extract_circle as extract_circle
from pancam_graph.initialise._extract import extract_free as extract_free
from pancam_graph.initialise._extract import extract_mast as extract_mast
from pancam_graph.initialise._from_poses import start_from_poses as start_from_poses
from pancam_graph.initialise._start import Start as Start
from pancam_graph.initialise._start import in_turns_of_telemetry as in_turns_of_telemetry
from pancam_graph.initialise._start import start_from_cameras as start_from_cameras
from pancam_graph.initialise._start import start_from_odometry as start_from_odometry
from pancam_graph.initialise._start import start_from_telemetry as start_from_telemetry
