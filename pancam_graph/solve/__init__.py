"""The adjustment of a traverse: prepare, screen, fit, judge."""

from pancam_graph.solve._adjustment import Adjustment as Adjustment
from pancam_graph.solve._diagnose import listed as listed
from pancam_graph.solve._eliminated import EliminatedSolver as EliminatedSolver
from pancam_graph.solve._optimise import InOrder as InOrder
from pancam_graph.solve._optimise import Iteration as Iteration
from pancam_graph.solve._optimise import OnGraph as OnGraph
from pancam_graph.solve._optimise import optimise as optimise
from pancam_graph.solve._optimise import parameters_of as parameters_of
from pancam_graph.solve._problem import Problem as Problem
from pancam_graph.solve._rejection import screen as screen
from pancam_graph.solve._solve import SolveOptions as SolveOptions
from pancam_graph.solve._solve import solve as solve
from pancam_graph.solve._stopping import StopRule as StopRule
from pancam_graph.solve.cross_validation._cross_validate import CrossValidation as CrossValidation
from pancam_graph.solve.cross_validation._cross_validate import cross_validate as cross_validate
