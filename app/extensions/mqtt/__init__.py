"""MQTT: topics of a broker as source, and a broker as output and receiver of alerts."""

from config.extensions import Extension, Part

OUTPUT = f"{__name__}.output:mqtt_output"

EXTENSION = Extension(
    sources={"mqtt": Part(f"{__name__}.schema:MqttSourceSection", f"{__name__}.source:open_mqtt")},
    outputs={
        "mqtt": Part(
            f"{__name__}.schema:MqttSection",
            OUTPUT,
            "MQTT broker to which the state is published: {host, port, prefix, ...}. Default: none.",
        )
    },
    receivers={"mqtt": Part(f"{__name__}.schema:MqttReceiverSection", OUTPUT)},
)
