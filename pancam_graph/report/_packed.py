"""What a page carries inside: text compressed and in letters."""

import base64
import gzip
from functools import lru_cache

from plotly.offline import get_plotlyjs

__all__ = ["packed", "packed_plotly"]


def packed(text: str) -> str:
    """Text compressed and in letters; the same letters for the same text."""
    return base64.b64encode(gzip.compress(text.encode("utf-8"), 9, mtime=0)).decode("ascii")


@lru_cache(maxsize=1)
def packed_plotly() -> str:
    """Plotly's script."""
    return packed(get_plotlyjs())
