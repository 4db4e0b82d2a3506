"""Exceptions of the package: one base class, one subclass per layer.

The text of an error says where (file and entry), what was expected and what was found.
"""

from pancam_graph.base.text import shortened, visible

__all__ = [
    "CameraError",
    "ClusterError",
    "GeometryError",
    "ImageError",
    "InputError",
    "PancamGraphError",
    "SolveError",
]


class PancamGraphError(Exception):
    """Base of everything that this package raises on purpose.

    Its text quotes files and names of the user's: it is one line that prints, of 1000 characters at most. The
    whole is in `args`.
    """

    def __str__(self) -> str:
        """The sentence."""
        return shortened(visible(super().__str__()))


class InputError(PancamGraphError):
    """A file, a folder or an entry that the user gave cannot be used."""


class CameraError(PancamGraphError):
    """Numbers that do not make a camera (zero focal length, a projection matrix of rank 2)."""


class GeometryError(PancamGraphError):
    """A geometric problem without a unique answer (a circle through collinear points)."""


class ImageError(InputError):
    """An image that cannot be read or does not fit its camera."""


class SolveError(PancamGraphError):
    """A problem that cannot be posed or factorised (no usable observations, a free direction)."""


class ClusterError(PancamGraphError):
    """Workers or a scheduler that cannot do the work, or do it no more. What they have found is kept."""
