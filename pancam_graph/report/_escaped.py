"""Text of the user's within HTML."""

import html

from pancam_graph.base.text import visible

__all__ = ["escape"]


def escape(text: str) -> str:
    """The text as HTML shows it: no tags, no ends of attributes, and an escape for what does not print."""
    return html.escape(visible(text))
