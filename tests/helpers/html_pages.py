# This source code is licensed under the MIT license found in the LICENSE file.
"""Parses an HTML page into text, tags and links."""

import re
from html.parser import HTMLParser
from pathlib import Path

_VOID = {"meta", "img", "rect", "br"}


class Page(HTMLParser):
    """Parses a page; fails on tags that are not closed."""

    def __init__(self, path: Path):
        super().__init__()
        self.source = path.read_text()
        self.open, self.tags, self.links, self.words = [], [], [], []
        self.feed(self.source)
        assert not self.open, f"not closed: {self.open}"
        self.text = re.sub(r"\s+", " ", " ".join(self.words))

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.links += [value for name, value in attributes if name in ("src", "href")]
        if tag not in _VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in _VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "script"):
            self.words.append(data)
