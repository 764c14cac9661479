"""Pass messages of a Kafka topic on to fleets of type push with a store, so that each counts once.

The key of a message is the name of its asset, the value is JSON such as {"time": ..., "values": {"winding": 41.5}}.
Offsets are committed once the fleet has stored the messages. The partition decides which of several fleets gets them.

Run: NISUS_TOKEN=... python docs/examples/kafka_to_fleet.py http://127.0.0.1:9901 http://127.0.0.1:9902
"""

import json
import os
import sys
import time
import urllib.request

from quixstreams import Application
from quixstreams.sinks import BatchingSink, SinkBatch

FLEETS = sys.argv[1:]


class FleetSink(BatchingSink):
    """Sends batches to POST /api/readings of fleets, again and again until they are stored."""

    def write(self, batch: SinkBatch) -> None:
        """Send a batch; a message is known by its partition and offset."""
        source = f"{batch.topic}/{batch.partition}"
        messages = [
            {**item.value, "asset": item.key.decode(), "source": source, "sequence": item.offset} for item in batch
        ]
        url = f"{FLEETS[batch.partition % len(FLEETS)]}/api/readings"
        while not self.is_stored(url, messages):
            time.sleep(1.0)

    def is_stored(self, url: str, messages: list):
        """Send messages; return whether the fleet has stored them."""
        headers = {"Authorization": f"Bearer {os.environ['NISUS_TOKEN']}", "Content-Type": "application/json"}
        request = urllib.request.Request(url, json.dumps(messages).encode(), headers)
        try:
            with urllib.request.urlopen(request) as answer:
                return json.load(answer)["stored"]
        except OSError:
            return False


app = Application("localhost:9092", consumer_group="nisus", commit_interval=1.0)
app.dataframe(app.topic("measurements", value_deserializer="json")).sink(FleetSink())
app.run()
