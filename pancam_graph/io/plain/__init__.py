"""Plain pictures with told pointing as a traverse: what `pancam-graph init` writes."""

from pancam_graph.io.plain._exif import Exif as Exif
from pancam_graph.io.plain._exif import read_exif as read_exif
from pancam_graph.io.plain._options import POINTING_COLUMNS as POINTING_COLUMNS
from pancam_graph.io.plain._options import STOP_COLUMNS as STOP_COLUMNS
from pancam_graph.io.plain._options import PlainOptions as PlainOptions
from pancam_graph.io.plain._plain_traverse import PlainTraverse as PlainTraverse
from pancam_graph.io.plain._plain_traverse import plain_traverse as plain_traverse
from pancam_graph.io.plain._write import write_plain as write_plain
