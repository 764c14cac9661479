"""UDP for Nisus: datagrams of JSON as source, the state as datagrams, and a tab that shows it."""

import json
import socket
import threading
from typing import Literal

from nisus.config.channels import MessagesSection
from nisus.config.extensions import Extension, Part
from nisus.config.fields import Host, Port, Section
from nisus.estimators.errors import SourceError


class UdpSourceSection(MessagesSection):
    """Datagrams to a port of this machine, each a message as of POST /api/readings."""

    type: Literal["udp"]
    """udp"""
    port: Port
    """The port."""


class UdpSource:
    live = utc = True

    def __init__(self, opening):
        from nisus.app.twin.sources.push import messages_of

        self._messages, self._report = messages_of(opening), opening.report
        self.read, self.now = self._messages.read, self._messages.now
        self._socket = socket.socket(type=socket.SOCK_DGRAM)
        try:
            self._socket.bind(("127.0.0.1", opening.section.port))
        except OSError as error:
            raise SourceError(f"source.port: {opening.section.port}: {error.strerror}; choose another one") from None
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self):
        while datagram := self._socket.recv(65_535):
            try:
                reason = self._messages.send([json.loads(datagram)])[0].reason
            except ValueError as error:
                reason = error
            if reason:
                self._report("datagram refused", f"udp: {reason}")

    def close(self):  # the empty datagram ends the thread
        self._socket.sendto(b"", self._socket.getsockname())


class UdpSection(Section):
    """Receiver of the state: {host, port}."""

    host: Host
    port: Port


class UdpOutput:
    name = "udp"

    def __init__(self, section, engine, secrets):
        from nisus.app.engine.copies import OutputLink

        self._address, self._socket = (section.host, section.port), socket.socket(type=socket.SOCK_DGRAM)
        self.link = lambda: OutputLink(True, f"{section.host}:{section.port}")
        self.start, self.stop = lambda: None, self._socket.close

    def publish(self, message):
        self._socket.sendto(message.model_dump_json().encode(), self._address)


def panel():
    return """export default (tab, { link }) => link.addEventListener("status", async () => {
      const { states } = await (await fetch("api/state")).json();
      tab.replaceChildren(...states.map(({ name, value, unit }) => `${name} ${value?.toFixed(2)} ${unit} `));
    });"""


EXTENSION = Extension(
    sources={"udp": Part("nisus_udp:UdpSourceSection", "nisus_udp:UdpSource")},
    outputs={"udp": Part("nisus_udp:UdpSection", "nisus_udp:UdpOutput", "Receiver of datagrams: {host, port}.")},
    panels={"States": Part("", "nisus_udp:panel")},
)
