"""Lines of standard input as measurements of a running twin: `nisus push`. The source type `push` is the core's."""

from config.extensions import Extension, Part

EXTENSION = Extension(commands={"push": Part(f"{__name__}.arguments:PushCommand", f"{__name__}.command:push")})
