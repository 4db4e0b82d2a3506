"""The `pancam-graph` command, and what the scripts of the repository share with it."""

from pancam_graph.cli._ending import run as run
from pancam_graph.cli._log import show_log as show_log
from pancam_graph.cli._main import main as main
from pancam_graph.cli._main import run_script as run_script
from pancam_graph.cli._parser import ScriptParser as ScriptParser
from pancam_graph.cli._progress import Progress as Progress
