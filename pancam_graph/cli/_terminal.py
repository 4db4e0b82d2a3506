"""A terminal as rich sees it, on which text of the user's has no effect but to be read."""

from typing import Any

from rich.console import Console, RenderableType
from rich.text import Text

from pancam_graph.base.text import visible
from pancam_graph.cli._streams import write_rendered

__all__ = ["Terminal", "print_on_terminal", "words"]


class Terminal(Console):
    """A console without markup, codes of emojis and automatic colours; strings are made `visible`."""

    def render_str(self, text: str, **how: Any) -> Text:
        """A string as it is shown, in one style."""
        plain = {"markup": False, "emoji": False, "highlight": False, "highlighter": None}
        return super().render_str(visible(text), **{**how, **plain})


def words(*parts: str | tuple[str, str]) -> Text:
    """Text put together from strings, and from strings with a style."""
    made = Text()
    for part in parts:
        text, style = (part, "") if isinstance(part, str) else part
        made.append(visible(text), style=style)
    return made


def print_on_terminal(*shown: RenderableType) -> None:
    """Print on standard output, which is a terminal."""
    console = Terminal()
    with console.capture() as captured:
        for renderable in shown:
            console.print(renderable)
    write_rendered("stdout", captured.get())
