"""First values of what the adjustment estimates: from telemetry, odometry, or given camera matrices."""

from pancam_graph.initialise._circle import CircleFit as CircleFit
from pancam_graph.initialise._circle import fit_circle as fit_circle
from pancam_graph.initialise._start import Start as Start
from pancam_graph.initialise._start import start_from_cameras as start_from_cameras
from pancam_graph.initialise._start import start_from_odometry as start_from_odometry
from pancam_graph.initialise._start import start_from_telemetry as start_from_telemetry
