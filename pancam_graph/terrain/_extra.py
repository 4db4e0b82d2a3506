"""Packages of the extra `terrain`, which are imported when a product needs them."""

from importlib import import_module
from typing import Any

from pancam_graph.base.errors import InputError

__all__ = ["needed", "require_extra"]

_PACKAGES = ("rasterio", "laspy", "lazrs")


def needed(package: str) -> Any:
    """A package of the extra. Raises InputError that names the extra where it is not installed."""
    try:
        return import_module(package)
    except ImportError as error:
        raise InputError(
            f"terrain: expected the Python package {package}, found none: pip install 'pancam-graph[terrain]'"
        ) from error


def require_extra() -> None:
    """Import all packages of the extra; for before a long run. Raises InputError as `needed` does."""
    for package in _PACKAGES:
        needed(package)
