"""Files of other programs, written from a solution or from a drive as telemetry has it."""

from pancam_graph.results.formats._source import Source as Source
from pancam_graph.results.formats._source import source_of as source_of
