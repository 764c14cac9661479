"""OPC UA: nodes of a server as source, and a server with the states as output."""

from config.extensions import Extension, Part

EXTENSION = Extension(
    sources={"opcua": Part(f"{__name__}.schema:OpcUaSourceSection", f"{__name__}.source:open_opcua")},
    outputs={
        "opcua": Part(
            f"{__name__}.schema:OpcUaSection",
            f"{__name__}.output:OpcUaOutput",
            "OPC UA server with the states as variables: {host, port, ...}. Default: none.",
        )
    },
)
