"""Packages of extras, which are imported when something needs them."""

from importlib import import_module
from typing import Any

from pancam_graph.base.errors import InputError

__all__ = ["needed"]


def needed(package: str, extra: str) -> Any:
    """A package of an extra. Raises InputError that names the extra where it is not installed."""
    try:
        return import_module(package)
    except ImportError as error:
        raise InputError(
            f"{extra}: expected the Python package {package}, found none: pip install "
            f"'pancam-graph[{extra}]', in a checkout pip install -e '.[{extra}]'"
        ) from error
