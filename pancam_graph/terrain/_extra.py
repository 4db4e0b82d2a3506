"""Packages of the extra `terrain`, which are imported when a product needs them."""

from typing import Any

from pancam_graph.base.extras import needed as needed_of

__all__ = ["needed", "require_extra"]

_PACKAGES = ("rasterio", "laspy", "lazrs")


def needed(package: str) -> Any:
    """A package of the extra. Raises InputError that names the extra where it is not installed."""
    return needed_of(package, "terrain")


def require_extra() -> None:
    """Import all packages of the extra; for before a long run. Raises InputError as `needed` does."""
    for package in _PACKAGES:
        needed(package)
