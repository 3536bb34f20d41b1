"""Minimal server of the VRPN protocol (version 7): trackers that send poses."""

import socket
import struct
import threading
import time

COOKIE = b"vrpn: ver. 07.38  0".ljust(24, b"\0")
SENDER, TYPE = -1, -2


def message(sender, kind, payload):
    """A message with its header; both are padded to 8 bytes."""
    now = time.time()
    header = struct.pack(">iiiiii", 24 + len(payload), int(now), int(now % 1 * 1e6), sender, kind, 0)
    return header + payload + b"\0" * (-len(payload) % 8)


def description(kind, number, name):
    text = name.encode() + b"\0"
    return message(number, kind, struct.pack(">i", len(text)) + text)


class VRPNServer:
    """Server on this host. `poses`: by name, position (m) and quaternion (x, y, z, w)."""

    def __init__(self, names, rate=100.0):
        self.names, self.rate = list(names), rate
        self.poses = {}
        self._requests = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._requests.bind(("127.0.0.1", 0))
        self._requests.settimeout(0.1)
        self.port = self._requests.getsockname()[1]
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self):
        self._closing.set()
        self._thread.join(5.0)
        self._requests.close()

    def _run(self):
        while not self._closing.is_set():
            try:
                # the client asks to be called at a port
                data, _ = self._requests.recvfrom(1000)
            except TimeoutError:
                continue
            host, port = data.rstrip(b"\0").split()
            with socket.create_connection((host.decode(), int(port)), timeout=5.0) as client:
                self._serve(client)

    def _serve(self, client):
        client.sendall(COOKIE)
        client.sendall(description(TYPE, 0, "vrpn_Tracker Pos_Quat"))
        for number, name in enumerate(self.names):
            client.sendall(description(SENDER, number, name))
        while not self._closing.is_set():
            for number, name in enumerate(self.names):
                if name in self.poses:
                    position, quaternion = self.poses[name]
                    payload = struct.pack(">ii7d", 0, 0, *position, *quaternion)
                    client.sendall(message(number, 0, payload))
            time.sleep(1.0 / self.rate)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()
