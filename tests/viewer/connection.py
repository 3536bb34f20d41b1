"""A page's connection for tests without a browser."""

import asyncio
import json

import numpy as np


def numbers(message):
    """Head and row of a frame."""
    values = np.frombuffer(message, np.float32)
    return values[:6], values[6:]


class Connection:
    """A connection in whose place the test stands: messages (or texts) to the session, and those it sends."""

    def __init__(self):
        self.given, self.sent = asyncio.Queue(), asyncio.Queue()

    def __aiter__(self):
        return self

    async def __anext__(self):
        given = await self.given.get()
        return given if isinstance(given, str) else json.dumps(given)

    async def send(self, message):
        await self.sent.put(message)

    async def until(self, true):
        """The next message for which something is true."""
        while True:
            message = await asyncio.wait_for(self.sent.get(), 20)
            if true(json.loads(message) if isinstance(message, str) else numbers(message)[0].tolist()):
                return message
