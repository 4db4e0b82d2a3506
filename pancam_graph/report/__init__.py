"""The report: one HTML file that explains a solution."""

from pancam_graph.report._drive import DriveStep as DriveStep
from pancam_graph.report._drive import write_drive as write_drive
from pancam_graph.report._plots import require_plots as require_plots
from pancam_graph.report._plots import write_plots as write_plots
from pancam_graph.report._write import write_mosaic_page as write_mosaic_page
from pancam_graph.report._write import write_report as write_report
from pancam_graph.report._write import write_terrain_page as write_terrain_page
