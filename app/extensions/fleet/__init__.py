"""Many assets of one twin, folded together: `nisus fleet FLEET.yaml`."""

from config.extensions import Extension, Part

EXTENSION = Extension(
    needs=("archive", "mqtt", "service"),
    commands={"fleet": Part(f"{__name__}.arguments:FleetCommand", f"{__name__}.command:run_fleet")},
)
