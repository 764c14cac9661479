"""Import for the fork server of `nisus serve`: memory that the processes of all twins share.

A process writes to the pages of an object that it uses, which makes them its own. Modules and Numba's tables of types
and functions, 175 MB, stay common for the most part. What libraries load or build at their first use is loaded here as
well: each process would do it again before its page is there.
"""

import imageio.v3
import numpy as np
import rich.console
import rich.panel
import rich.table  # noqa: F401
import uvicorn.lifespan.off
import uvicorn.loops.auto
import uvicorn.protocols.websockets.auto  # noqa: F401
from numba.core.registry import cpu_target

from app.cli import open_twin
from app.explore import rows
from app.scene import view
from app.web import server
from config.schema import TwinSection
from sources import pacer
from sources.tables import table

from . import command, metrics

__all__ = ["command", "metrics", "open_twin", "pacer", "rows", "server", "table", "view"]

cpu_target.typing_context.refresh()
cpu_target.target_context.refresh()
TwinSection.model_rebuild()
imageio.v3.imwrite("<bytes>", np.zeros((1, 1, 3), np.uint8), extension=".jpeg")  # Pillow looks for its formats
