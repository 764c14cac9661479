"""Several twins behind one port, `nisus serve`, and metrics for Prometheus."""

from config.extensions import Extension, Part

EXTENSION = Extension(
    commands={"serve": Part(f"{__name__}.arguments:ServeCommand", f"{__name__}.command:serve")},
    routes={"/metrics": Part("", f"{__name__}.metrics:metrics_route")},
)
