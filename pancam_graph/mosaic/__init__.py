"""Mosaics of what the images of a stop show, with telemetry's and with the refined pointing."""

from pancam_graph.mosaic._files import MOSAIC_INDEX as MOSAIC_INDEX
from pancam_graph.mosaic._files import MOSAIC_PAGE as MOSAIC_PAGE
from pancam_graph.mosaic._files import WrittenMosaics as WrittenMosaics
from pancam_graph.mosaic._files import write_mosaics as write_mosaics
from pancam_graph.mosaic._make import Mosaic as Mosaic
from pancam_graph.mosaic._make import StopMosaics as StopMosaics
from pancam_graph.mosaic._make import make_mosaics as make_mosaics
from pancam_graph.mosaic._mosaic_options import MosaicOptions as MosaicOptions
from pancam_graph.mosaic._projections import Cylinder as Cylinder
from pancam_graph.mosaic._projections import Ground as Ground
from pancam_graph.mosaic._seam_error import Overlap as Overlap
from pancam_graph.mosaic._seam_error import SeamError as SeamError
from pancam_graph.mosaic._stop_files import Blink as Blink
