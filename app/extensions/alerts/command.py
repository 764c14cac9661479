"""Alerts to programs."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

from app.engine.outputs.alerts import AlertMessage
from app.twin.secrets import Secrets
from estimators.compiled.orphan import killed_with_parent

from .schema import CommandSection


class CommandReceiver:
    """Starts a program for each alert."""

    def __init__(self, section: CommandSection, folder: Path, _secrets: Secrets) -> None:
        """`folder`: of the YAML."""
        program, *arguments = section.command
        self._command = [str(folder / program) if program.startswith("./") else program, *arguments]
        self._timeout = section.timeout

    def send(self, alert: AlertMessage) -> None:
        """See `Receiver`."""
        text = alert.model_dump_json()
        try:
            # A file, not a pipe: what the program leaves running would hold that open.
            with tempfile.TemporaryFile() as said:
                code = subprocess.run(
                    self._command,
                    input=text.encode(),
                    stdout=subprocess.DEVNULL,
                    stderr=said,
                    timeout=self._timeout,
                    preexec_fn=killed_with_parent,
                ).returncode
                said.seek(max(0, said.tell() - 1000) if code else 0)
                last = (said.read(1000).decode(errors="replace").strip().splitlines() or [""])[-1]
        except subprocess.TimeoutExpired:
            raise OSError(f"it did not end within {self._timeout:g} s") from None
        if code:
            raise OSError(f"it ended with {code}{': ' if last else ''}{last}")
