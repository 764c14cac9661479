"""Sections of the YAML: HTTP servers, e-mail addresses and programs as receivers of alerts."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from config.fields import Duration, EnvironmentName, Host, Port, Section, Text, Texts, refused


class WebhookSection(Section):
    """A receiver of alerts: an HTTP server, to which each is sent by POST as JSON."""

    type: Literal["webhook"]
    """webhook"""
    url: Annotated[str, Field(pattern=r"^(https?://\S+|\$[A-Za-z_][A-Za-z0-9_]*)$")]
    """Address, http or https; or $NAME: the environment variable that holds it."""
    secret_env: EnvironmentName | None = None
    """Environment variable with the key of the signature, HMAC-SHA256. Default: none, alerts are not signed."""
    heartbeat: Duration | None = None
    """Seconds between two messages that the twin runs, so that the receiver notices when they end. Default: never."""


class EmailSection(Section):
    """A receiver of alerts: e-mail addresses."""

    type: Literal["email"]
    """email"""
    to: Texts
    """Addresses of the recipients."""
    sender: Text
    """Address of the sender."""
    server: Host = "localhost"
    """Mail server. Default: localhost."""
    port: Port = 25
    """Its port. Default: 25; 587 is usual with starttls, 465 with tls."""
    security: Literal["none", "starttls", "tls"] = "none"
    """Encryption of the connection. Default: none, for a server on this machine."""
    user: Text | None = None
    """User name at the server. Default: none, no login."""
    password_env: EnvironmentName | None = None
    """Environment variable with the password."""

    @model_validator(mode="after")
    def _login(self) -> EmailSection:
        if (self.user is None) != (self.password_env is None):
            raise refused("absent", "needs both user and password_env, or neither")
        return self


class CommandSection(Section):
    """A receiver of alerts: a program, which is started for each alert and reads it as JSON from standard input."""

    type: Literal["command"]
    """command"""
    command: Texts
    """Program and its arguments; a program that begins with ./ is beside the YAML. No shell is involved."""
    timeout: Duration = 30.0
    """Seconds after which it is ended. Default: 30."""
