"""Recorded scores: written when they are accepted, and read to compare with."""

from __future__ import annotations

import contextlib
import json
import os
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from config.files import read_text, shown_path, writing
from config.guard_schema import ReferenceSection
from config.problems import report, shown
from config.tunings import folders
from config.yaml_lines import parse
from config.yaml_text import as_flow
from estimators.errors import ConfigError, printable

from ...live.tunings.versions import now
from .figures import Judged

DIGITS = 10
"""Significant digits of a figure: a thousandth of what it may change by at least."""


def read_reference(path: Path) -> ReferenceSection | None:
    """Read recorded scores; None if there are none.

    Raises:
        ConfigError: If the file is wrong.
    """
    if not path.is_file():
        return None
    file = shown_path(path)
    data, places = parse(read_text(path, "nisus guard --accept"), file)
    if not isinstance(data, dict):
        raise ConfigError(f"{file}:1: the file is {shown(data)}; write it anew with `nisus guard --accept`")
    try:
        return ReferenceSection.model_validate(data)
    except ValidationError as error:
        raise report(error, data, places) from None


def write_reference(path: Path, name: str, found: ReferenceSection) -> None:
    """Write recorded scores.

    Raises:
        ConfigError: If the file cannot be written.
    """
    lines = [f"# What `nisus guard` compares {name} with; `nisus guard --accept --note ...` writes it."]
    for key, value in found.model_dump(mode="json", exclude_none=True).items():
        if key == "figures":
            lines += ["figures:", *(f"  {as_flow(name)}: {as_flow(_rounded(each))}" for name, each in value.items())]
        else:
            lines.append(f"{key}: {as_flow(_rounded(value))}")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: [float(f"{number:.3g}") for number in item] if key == "allowed" else _rounded(item)
                for key, item in value.items()}  # fmt: skip
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


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


FILE = "guard.json"
"""Name of the file, in the folder of the versions."""


def keep_last(twin: Path, found: Sequence[Guarded]) -> None:
    """Keep what became of recordings of a twin; what was said of its other recordings stays.

    A folder that cannot be written to is no reason for a verdict to fail, and is passed over.
    """
    path = folders(twin)[0] / FILE
    said = {each["recording"]: each for each in last(twin)}
    said |= {each.name: _said(each) for each in found}
    text = json.dumps({"recordings": list(said.values())}, indent=1)
    other = path.with_name(f".{FILE}.{os.getpid()}")
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        other.write_text(text, encoding="utf-8")
        other.replace(path)


def last(twin: Path) -> list[dict[str, Any]]:
    """What was said last of each recording of a twin, the newest first; nothing if nothing was, or it cannot be read.

    Each has `recording`, `at` (UTC), `version` (tuning), `figures` (how many), `worse` and `better` (a line each) and
    `failure`, empty unless it could not be folded.
    """
    try:
        found = json.loads((folders(twin)[0] / FILE).read_text(encoding="utf-8"))["recordings"]
        return sorted(found, key=lambda each: (each["at"], each["recording"]), reverse=True)
    except (OSError, ValueError, KeyError, TypeError):
        return []


def _said(each: Guarded) -> dict[str, Any]:
    return {
        "recording": each.name,
        "at": now(),
        "version": each.version,
        "figures": len(each.judged),
        "worse": [in_words(judged) for judged in each.judged if judged.worse],
        "better": [f"{j.figure} was {j.before:.6g} and is {j.now:.6g}" for j in each.judged if j.better],
        "failure": each.failure,
    }
