"""Reads HTML pages."""

import html.parser


class Reader(html.parser.HTMLParser):
    """Cells with their class, sources of pictures, and that every element is closed."""

    def __init__(self, text):
        super().__init__()
        self.cells = []
        self.sources = []
        self.links = []
        self.open = []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        if tag == "img":
            self.sources.append(attributes["src"])
        elif tag not in ("meta", "link", "br", "input"):
            self.open.append(tag)
        self.links += [attributes[name] for name in ("href", "action") if name in attributes]
        if tag == "td":
            self.cells.append([attributes.get("class", ""), ""])

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "td":
            self.cells[-1][1] += data
