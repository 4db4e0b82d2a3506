"""Readers and writers, one file format a module."""

from pancam_graph.io.image_files import read_image as read_image
from pancam_graph.io.traverse_json import read_traverse as read_traverse
from pancam_graph.io.traverse_json import write_traverse as write_traverse
