"""The beginning of every page, and text inside it, compressed and written in letters (gzip and base64)."""

import base64
import gzip
from functools import lru_cache

__all__ = ["HEAD", "UNPACKED", "jpeg_uri", "packed", "packed_plotly"]

HEAD = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline';
script-src 'unsafe-inline' 'unsafe-eval'; img-src data: blob:; connect-src data: blob:">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<header>
<h1>{title}</h1>
<p class="lead">{lead}</p>
"""
"""Template of the beginning of a page, with places for a title, a style and an introduction."""
UNPACKED = """async function unpacked(id, binary = false) {
  const packed = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const response = new Response(stream);
  return binary ? response.arrayBuffer() : response.text();
}"""
"""Script function that returns what `packed` made into the content of an element: text, or bytes."""


def packed(content: str | bytes) -> str:
    """Text or bytes compressed and written in letters; the same content always gives the same letters."""
    raw = content.encode("utf-8") if isinstance(content, str) else content
    return base64.b64encode(gzip.compress(raw, 9, mtime=0)).decode("ascii")


def jpeg_uri(jpeg: bytes) -> str:
    """The address of a picture that is in the page itself."""
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode("ascii")


@lru_cache(maxsize=1)
def packed_plotly() -> str:
    """Plotly's script."""
    from plotly.offline import get_plotlyjs  # noqa: PLC0415  only a page that is written needs Plotly

    return packed(get_plotlyjs())
