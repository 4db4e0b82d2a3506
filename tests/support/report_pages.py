"""Reading a page of the report: its structure and its packed figures."""

import base64
import gzip
import json
import re
from html.parser import HTMLParser
from typing import Any

VOID = {"meta", "link", "br", "img", "input", "hr"}


def unpacked(page: str, name: str) -> str:
    """Text that is packed in one of the page's script elements."""
    packed = re.search(f'<script type="text/plain" id="{name}">([^<]*)</script>', page)
    assert packed is not None
    return gzip.decompress(base64.b64decode(packed[1])).decode()


def figures_of(page: str) -> dict[str, Any]:
    """The packed figures, by id, with everything else that the script gets."""
    data = json.loads(unpacked(page, "packed-figures"))
    return {**data, **{figure["id"]: figure for figure in data["figures"]}}


class Structure(HTMLParser):
    """Follows tags, so that a page with unbalanced or unknown nesting is noticed."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.resources: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            if name in {"src", "href", "srcset", "data", "action"}:
                self.resources.append(value or "")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1:] not in (["script"], ["style"]):
            self.text.append(data)


def parsed(page: str) -> Structure:
    structure = Structure()
    structure.feed(page)
    structure.close()
    assert structure.open == []
    assert len(set(structure.ids)) == len(structure.ids)
    return structure
