"""Traverses with known truth: observed points, or rendered images."""

from pancam_graph.simulate._drive import TelemetryStart as TelemetryStart
from pancam_graph.simulate._drive import Truth as Truth
from pancam_graph.simulate._folder import check_new as check_new
from pancam_graph.simulate._folder import write_rendering as write_rendering
from pancam_graph.simulate._folder import write_truth as write_truth
from pancam_graph.simulate._points import Simulation as Simulation
from pancam_graph.simulate._points import simulate as simulate
from pancam_graph.simulate._render import Rendering as Rendering
from pancam_graph.simulate._render import render as render
from pancam_graph.simulate._simulation_options import DriveOptions as DriveOptions
from pancam_graph.simulate._simulation_options import RenderOptions as RenderOptions
from pancam_graph.simulate._simulation_options import SimulationOptions as SimulationOptions
