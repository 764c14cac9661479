"""The cards of the gallery: every bundled twin has a picture that loads nothing."""

import re
import xml.etree.ElementTree as ET

import pytest

from app.web.gallery.cards import picture_file
from config.loader import find, shipped

SVG = "{http://www.w3.org/2000/svg}"


@pytest.mark.parametrize("name", shipped())
def test_every_twin_that_ships_has_a_picture_that_loads_nothing(name):
    text = picture_file(find(name)).read_text()
    root = ET.fromstring(text)
    assert root.get("viewBox") == "0 0 320 140" and len(text) < 100_000
    assert root.get("class") == "card-picture"
    assert any(item.tag in (f"{SVG}path", f"{SVG}image") for item in root.iter())
    assert not re.search(r"<script|\son\w+=|url\(|https?://(?!www\.w3\.org/(2000/svg|1999/xlink))", text)
    for image in root.iter(f"{SVG}image"):
        links = [value for key, value in image.attrib.items() if key.endswith("href")]
        assert links and all(link.startswith("data:image/png;base64,") for link in links)
