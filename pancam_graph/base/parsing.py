"""Python's parser of its own language, which one thread at a time may use."""

from threading import Lock

__all__ = ["PARSING"]

PARSING = Lock()
"""Held while a text is parsed, also the header of an .npy file: Python 3.11 confuses the depths of parsers in
several threads, and raises SystemError."""
