"""CAN buses and logs of CAN frames."""

import importlib
import sys
from importlib.util import find_spec
from os import PathLike

from estimators.errors import SourceError

# python-can imports asammdf for MF4, and with it pandas and lxml: 0.7 s and 64 MB. Nisus reads MF4 in a process of its
# own, which imports asammdf itself; only `log_writer` needs python-can's support.
_present = "asammdf" in sys.modules
sys.modules.setdefault("asammdf", None)  # type: ignore[arg-type]
try:
    import can
finally:
    if not _present:
        del sys.modules["asammdf"]


def check_mf4(path: str | PathLike[str]) -> None:
    """Refuse an MF4 file where asammdf is not installed.

    Raises:
        SourceError: Naming the command that installs it.
    """
    if find_spec("asammdf") is None:
        raise SourceError(f"{path}: MF4 needs asammdf: pip install 'nisus[mf4]'")


def log_writer(path: str | PathLike[str]) -> can.Logger:
    """Return a writer of frames in the format that the file's ending names.

    Raises:
        SourceError: If the package of that format is not installed.
    """
    if str(path).lower().endswith(".mf4"):
        check_mf4(path)
        importlib.reload(importlib.import_module("can.io.mf4"))
    return can.Logger(path)
