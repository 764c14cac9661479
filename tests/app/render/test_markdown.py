"""docs/alarms.md as a page: every heading that an episode names is there, and nothing of the markup is left."""

import re

from app.engine.outputs.alarm_guide import alarms_text, as_html
from estimators.diagnostics.detectors import CAUSES, anchor
from tests.app.cli.test_check import ParsedHtml


def test_forms():
    text = (
        "# A *b* & <c>\n\none\ntwo `x*y*` **z** *n `m`* [l](m)\n\n- first\n  more\n- *second*\n\n"
        "| a | b |\n|---|---|\n| 1 | `2` |\n"
    )
    assert as_html(text) == (
        '<h1 id="a-b--c">A <em>b</em> &amp; &lt;c&gt;</h1>\n<p>one\ntwo <code>x*y*</code> <strong>z</strong> '
        "<em>n <code>m</code></em> [l](m)</p>\n<ul>\n<li>first\nmore</li>\n<li><em>second</em></li>\n</ul>\n"
        "<table>\n<thead>\n<tr>\n<th>a</th>\n<th>b</th>\n</tr>\n</thead>\n"
        "<tbody>\n<tr>\n<td>1</td>\n<td><code>2</code></td>\n</tr>\n</tbody>\n</table>\n"
    )


def test_the_whole_of_it():
    found = ParsedHtml(as_html(alarms_text()))
    ids = [value for _, name, value in found.attributes if name == "id"]
    assert {anchor(cause) for cause in CAUSES} <= set(ids)
    assert len(ids) == len(set(ids)) == len(re.findall(r"^#", alarms_text(), re.MULTILINE))
    words = " ".join("".join(found.text).split())
    plain = re.sub(r"^\|---.*$|^#+ |^- |[*`|]", " ", alarms_text(), flags=re.MULTILINE)
    squeezed = [re.sub(r"\s", "", text) for text in (re.sub(r"[*`|]", "", words), plain)]
    assert squeezed[0] == squeezed[1]
    assert "**" not in words and "|" not in words
