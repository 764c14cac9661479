"""Alerts to HTTP servers, by e-mail and to programs. Rules and queues are the core's: app/engine/outputs."""

from config.extensions import Extension, Part

EXTENSION = Extension(
    receivers={
        "webhook": Part(f"{__name__}.schema:WebhookSection", f"{__name__}.webhook:Webhook"),
        "email": Part(f"{__name__}.schema:EmailSection", f"{__name__}.mail:Mail"),
        "command": Part(f"{__name__}.schema:CommandSection", f"{__name__}.command:CommandReceiver"),
    }
)
