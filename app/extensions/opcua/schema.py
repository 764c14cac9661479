"""Sections of the YAML: nodes of an OPC UA server as source, and a server with the states as output."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from config.channels import MessagesSection
from config.fields import Duration, EnvironmentName, Host, Port, Section, Text, refused


class OpcUaSourceSection(MessagesSection):
    """Nodes of an OPC UA server, by subscription."""

    type: Literal["opcua"]
    """opcua"""
    url: Annotated[str, Field(pattern=r"^opc\.tcp://\S+$")]
    """Address of the server: opc.tcp://plc.local:4840."""
    nodes: Annotated[dict[Text, Text], Field(min_length=1)]
    """Node ids by the names of their values: {LT101: "ns=2;s=Tank.Level"}."""
    every: Duration = 0.1
    """Publishing interval, s. Default: 0.1."""


class OpcUaSection(Section):
    """An OPC UA server with the states as variables."""

    host: Host = "127.0.0.1"
    """Address at which it listens. Default: 127.0.0.1; any other needs user and password_env."""
    port: Port = 4840
    """Its port. Default: 4840."""
    user: Text | None = None
    """Name of the only user who may read. Default: everyone on this machine."""
    password_env: EnvironmentName | None = None
    """Environment variable with the password."""

    @model_validator(mode="after")
    def _guarded(self) -> OpcUaSection:
        if (self.user is None) != (self.password_env is None):
            raise refused("absent", "needs both user and password_env, or neither")
        if self.user is None and self.host not in ("127.0.0.1", "localhost", "::1"):
            raise refused("relation", "is not this machine; give user and password_env too", "host")
        return self
