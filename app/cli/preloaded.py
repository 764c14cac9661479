"""Import for the fork server of `nisus serve`: memory that the processes of all twins share.

A process writes to the pages of an object that it uses, which makes them its own. Modules and Numba's tables of types
and functions, 175 MB, stay common for the most part.
"""

from numba.core.registry import cpu_target

from ..views.rerun import rows
from ..views.viser import view
from ..web import server
from . import open_twin, serve

__all__ = ["open_twin", "rows", "serve", "server", "view"]

cpu_target.typing_context.refresh()
cpu_target.target_context.refresh()
