"""A Modbus TCP device, after the Modbus Application Protocol 1.1b3 and Messaging on TCP/IP 1.0b."""

import socket
import socketserver
import struct
import threading
from contextlib import suppress

REGISTERS = {3: "holding", 4: "input"}
BITS = {1: "coil", 2: "discrete"}
ILLEGAL_ADDRESS = 2


class Device(socketserver.ThreadingTCPServer):
    """Answers requests for the registers and bits that it was given; the others it refuses."""

    daemon_threads = allow_reuse_address = True

    def __init__(self, port=0):
        super().__init__(("127.0.0.1", port), Connection)
        self.port = self.server_address[1]
        self.tables = {name: {} for name in (*REGISTERS.values(), *BITS.values())}
        self.requests, self.connections = [], []
        threading.Thread(target=self.serve_forever, args=(0.01,), daemon=True).start()

    def give(self, address, data, table="holding"):
        """Set registers from bytes, two each, in one go."""
        words = struct.unpack(f">{len(data) // 2}H", data)
        self.tables[table] = self.tables[table] | {address + k: word for k, word in enumerate(words)}

    def stop(self):
        self.shutdown()
        self.server_close()
        for connection in self.connections:
            with suppress(OSError):  # closed by the client
                connection.shutdown(socket.SHUT_RDWR)


class Connection(socketserver.StreamRequestHandler):
    def setup(self):
        super().setup()
        self.server.connections.append(self.connection)

    def handle(self):
        try:
            while head := self.rfile.read(7):
                transaction, protocol, length, device = struct.unpack(">HHHB", head)
                function, first, count = struct.unpack(">BHH", self.rfile.read(length - 1))
                answer = self.answer(device, function, first, count)
                self.wfile.write(struct.pack(">HHHB", transaction, protocol, len(answer) + 1, device) + answer)
        except (OSError, ValueError, struct.error):  # closed by either side
            pass

    def answer(self, device, function, first, count):
        self.server.requests.append((device, function, first, count))
        table = self.server.tables[(REGISTERS | BITS)[function]]
        if any(address not in table for address in range(first, first + count)):
            return struct.pack(">BB", function | 0x80, ILLEGAL_ADDRESS)
        values = [table[address] for address in range(first, first + count)]
        if function in BITS:
            data = sum(bit << k for k, bit in enumerate(values)).to_bytes((count + 7) // 8, "little")
        else:
            data = struct.pack(f">{count}H", *values)
        return struct.pack(">BB", function, len(data)) + data
