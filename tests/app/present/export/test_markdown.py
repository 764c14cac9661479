"""docs/alarms.md as a page: every heading that an episode names is there, and nothing of the markup is left."""

import re
from html.parser import HTMLParser

from app.present.export.alarm_guide import alarms_text, as_html
from estimators.diagnostics.detectors import CAUSES, anchor


class Texts(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.open, self.said, self.ids, self.tags = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.open.append(tag)
        self.tags.append(tag)
        self.ids += [value for name, value in attrs if name == "id"]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.said.append(data)


def test_forms():
    text = (
        "# A *b* & <c>\n\none\ntwo `x*y*` **z**\n\n- first\n  more\n- *second*\n\n| a | b |\n|---|---|\n| 1 | `2` |\n"
    )
    assert as_html(text) == (
        '<h1 id="a-b--c">A <em>b</em> &amp; &lt;c&gt;</h1>\n<p>one two <code>x*y*</code> <strong>z</strong></p>\n'
        "<ul>\n<li>first more</li>\n<li><em>second</em></li>\n</ul>\n"
        "<table>\n<tr><th>a</th><th>b</th></tr>\n<tr><td>1</td><td><code>2</code></td></tr>\n</table>"
    )


def test_the_whole_of_it():
    found = Texts(as_html(alarms_text()))
    assert not found.open and {anchor(cause) for cause in CAUSES} <= set(found.ids)
    assert len(found.ids) == len(set(found.ids)) == len(re.findall(r"^#", alarms_text(), re.MULTILINE))
    words = " ".join("".join(found.said).split())
    plain = re.sub(r"^\|---.*$|^#+ |^- |[*`|]", " ", alarms_text(), flags=re.MULTILINE)
    squeezed = [re.sub(r"\s", "", text) for text in (re.sub(r"[*`|]", "", words), plain)]
    assert squeezed[0] == squeezed[1]
    assert "**" not in words and "|" not in words
