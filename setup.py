"""Put all packages of an installation into `nisus`: in a wheel `nisus.app`, in the checkout and in its tests `app`.

An editable installation is the checkout, where nisus/__init__.py gives the same names.
"""

import re
import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

PACKAGES = ("app", "config", "estimators", "sources")

IMPORTS = re.compile(rf"^(\s*(?:from|import) )(?=(?:{'|'.join(PACKAGES)})[. ])", re.MULTILINE)
NAMES = re.compile(rf"(?<=\")(?=(?:{'|'.join(PACKAGES)})(?:\.\w+)+\")")


class BuildPy(build_py):
    """Moves what was built into the package, and renames what it imports."""

    def run(self) -> None:
        """Build."""
        super().run()
        if self.editable_mode:
            return
        built = Path(self.build_lib)
        for package in PACKAGES:
            shutil.copytree(built / package, built / "nisus" / package, dirs_exist_ok=True)
            shutil.rmtree(built / package)
        for path in (built / "nisus").rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            path.write_text(NAMES.sub("nisus.", IMPORTS.sub(r"\1nisus.", text)), encoding="utf-8")


setup(cmdclass={"build_py": BuildPy})
