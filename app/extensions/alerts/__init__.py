"""Alerts by e-mail and to programs. Rules, queues and the web hook are the core's: app/engine/outputs."""

from config.extensions import Extension, Part

EXTENSION = Extension(
    receivers={
        "email": Part(f"{__name__}.schema:EmailSection", f"{__name__}.mail:Mail"),
        "command": Part(f"{__name__}.schema:CommandSection", f"{__name__}.command:CommandReceiver"),
    }
)
