"""CAN buses and logs of CAN frames."""

import importlib
import sys
from os import PathLike

# python-can imports asammdf for MF4, and with it pandas and lxml: 0.7 s and 64 MB. Nisus reads MF4 in a process of its
# own, which imports asammdf itself; only `log_writer` needs python-can's support.
_present = "asammdf" in sys.modules
sys.modules.setdefault("asammdf", None)  # type: ignore[arg-type]
try:
    import can
finally:
    if not _present:
        del sys.modules["asammdf"]


def log_writer(path: str | PathLike[str]) -> can.Logger:
    """Return a writer of frames in the format that the file's ending names."""
    if str(path).lower().endswith(".mf4"):
        importlib.reload(importlib.import_module("can.io.mf4"))
    return can.Logger(path)
