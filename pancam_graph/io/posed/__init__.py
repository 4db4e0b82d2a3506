"""Cameras with poses as other programs write them: COLMAP models, Bundler, CAHVOR files."""

from pancam_graph.io.posed._posed_camera import PosedCamera as PosedCamera
from pancam_graph.io.posed._posed_camera import images_of as images_of
from pancam_graph.io.posed._read import POSED_FORMATS as POSED_FORMATS
from pancam_graph.io.posed._read import PosedFormat as PosedFormat
from pancam_graph.io.posed._read import read_posed as read_posed
