"""The laboratory: faults made on purpose (`nisus stress`), and recordings folded again (`nisus guard`)."""

from config.extensions import Extension, Part

EXTENSION = Extension(
    commands={
        "guard": Part(f"{__name__}.arguments:GuardCommand", f"{__name__}.guard.command:guard"),
        "stress": Part(f"{__name__}.arguments:StressCommand", f"{__name__}.stress.command:stress_twin"),
    }
)
