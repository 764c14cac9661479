"""CAN buses and logs of CAN frames."""

import sys

# python-can imports asammdf for its own MF4 reader, and with it pandas and lxml: 0.7 s and 64 MB. Nisus reads MF4 files
# in a process of their own, which imports asammdf itself.
_present = "asammdf" in sys.modules
sys.modules.setdefault("asammdf", None)  # type: ignore[arg-type]
try:
    import can  # noqa: F401
finally:
    if not _present:
        del sys.modules["asammdf"]
