"""The verdict of a guard as JUnit XML, which CI systems show: a suite for each recording, a case for each figure."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass

from estimators.errors import printable

from .verdict import Judged


@dataclass(frozen=True)
class Guarded:
    """What became of one recording: its figures, or why there are none; `absent` if it is not there."""

    name: str
    version: str = ""
    judged: Sequence[Judged] = ()
    failure: str = ""
    absent: str = ""
    seconds: float = 0.0


def junit(found: Sequence[Guarded], *, absent_fails: bool) -> bytes:
    """The document.

    Args:
        found: Every recording.
        absent_fails: Whether one that is not there is an error, and not skipped.
    """
    root = ET.Element("testsuites", name="nisus guard")
    for each in found:
        suite = ET.SubElement(root, "testsuite", name=each.name, time=f"{each.seconds:.3f}")
        counts = {"tests": 0, "failures": 0, "errors": 0, "skipped": 0}

        def case(name: str, suite: ET.Element = suite, each: Guarded = each, counts: dict = counts) -> ET.Element:
            counts["tests"] += 1
            return ET.SubElement(suite, "testcase", classname=f"nisus.guard.{each.name}", name=name)

        if each.failure or (each.absent and absent_fails):
            counts["errors"] += 1
            ET.SubElement(case("fold"), "error", message=printable(each.failure or each.absent))
        elif each.absent:
            counts["skipped"] += 1
            ET.SubElement(case("fold"), "skipped", message=printable(each.absent))
        for judged in each.judged:
            element = case(judged.figure)
            if judged.worse:
                counts["failures"] += 1
                ET.SubElement(element, "failure", message=in_words(judged))
        for name, count in counts.items():
            suite.set(name, str(count))
    for name in ("tests", "failures", "errors", "skipped"):
        root.set(name, str(sum(int(suite.get(name, "0")) for suite in root)))
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True)


def in_words(judged: Judged) -> str:
    """A figure that got worse, in one line."""
    if judged.now != judged.now:
        return f"{judged.figure} was {judged.before:.6g} and is not there any more"
    return (
        f"{judged.figure} was {judged.before:.6g} and is {judged.now:.6g}: worse by {judged.change:.3g}, "
        f"allowed {judged.allowed:.3g}"
    )
