"""Text of the user's within HTML."""

import html
import json

from pancam_graph.base.text import visible

__all__ = ["escape", "script_json"]


def escape(text: str) -> str:
    """The text as HTML shows it: no tags, no ends of attributes, and an escape for what does not print."""
    return html.escape(visible(text))


def script_json(value: object) -> str:
    """A value as JSON that stands within an element of the page: no text of it ends the element."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
