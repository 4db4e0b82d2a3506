"""Tables of many rows as text: columns of names, whole numbers and decimal numbers, written in blocks."""

from pancam_graph.results.table._csv import Column as Column
from pancam_graph.results.table._csv import Names as Names
from pancam_graph.results.table._csv import csv_blocks as csv_blocks
