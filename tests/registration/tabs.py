"""Requests to the server of the page, and tabs that send what the page's scripts do."""

import asyncio
import contextlib
import http.client
import json
import struct
import uuid
from urllib.parse import urlsplit

import pytest

pytest.importorskip("tornado", reason="tornado is not installed")

from tornado.httpclient import HTTPRequest
from tornado.websocket import websocket_connect


def ask(address, path="", method="GET", body=None, **headers):
    """Status, headers and body of an answer."""
    where = urlsplit(address)
    connection = http.client.HTTPConnection("127.0.0.1", where.port, timeout=60)
    connection.putrequest(method, f"/{path}", skip_host=True)
    given = {"Host": where.netloc} | {name.replace("_", "-"): value for name, value in headers.items()}
    for name, value in given.items():
        if value is not None:
            connection.putheader(name, value)
    connection.endheaders(body)
    answer = connection.getresponse()
    found = answer.status, answer.headers, answer.read()
    connection.close()
    return found


class Tab:
    """What the page's scripts do: an edit is kept until it is saved, and sent again after a lost connection."""

    def __init__(self, address, token="", client=None):
        self.address, self.token = address, token
        self.client = client or uuid.uuid4().hex
        self.pairs, self.order, self.number = {}, [], 0
        self.kept, self.heard, self.added, self.said = [], [], {}, []
        self.problem = None

    async def connect(self):
        where = urlsplit(self.address)
        url = f"ws://{where.netloc}/socket?client={self.client}&work={self.token}"
        headers = {"Origin": f"http://{where.netloc}"}
        self.socket = await websocket_connect(HTTPRequest(url, headers=headers), max_message_size=1 << 28)
        OPEN.append(self.socket)
        await self.until(lambda tab: tab.greeted)

    greeted = False

    async def listen(self):
        message = await asyncio.wait_for(self.socket.read_message(), 60)
        if message is None:
            raise ConnectionError
        if isinstance(message, bytes):
            header = json.loads(message[4 : 4 + struct.unpack("<I", message[:4])[0]])
            self.heard.append(header)
            if header["type"] == "frame":
                await self.send(type="drawn", number=header["number"])
            return
        message = json.loads(message)
        self.heard.append(message)
        kind = message["type"]
        if kind in ("hello", "moved"):
            self.token = message["token"]
        if kind == "hello":
            for edit in self.kept:
                if edit["number"] > message["heard"]:
                    await self.socket.write_message(json.dumps(edit))
        if kind == "work":
            self.greeted = True
            if message["all"]:
                self.pairs = {}
            self.pairs |= {row[0]: row[1:] for row in message["changed"]}
            if message["order"] is not None:
                self.order = message["order"]
        if kind == "done":
            self.added[message["number"]] = message["added"]
        if kind == "saved":
            self.problem = message["problem"]
            self.kept = [edit for edit in self.kept if edit["number"] > message["number"]]
        if kind == "message":
            self.said.append(message["text"])

    async def until(self, what):
        while not what(self):
            await self.listen()

    async def send(self, **message):
        await self.socket.write_message(json.dumps(message))

    async def edit(self, do, **values):
        self.number += 1
        edit = {"type": "edit", "number": self.number, "do": do, **values}
        self.kept.append(edit)
        await self.socket.write_message(json.dumps(edit))
        return self.number

    async def add(self, place):
        number = await self.edit("add", side="moving", place=place)
        await self.until(lambda tab: tab.added.get(number) in tab.pairs)
        return self.added[number]

    async def saved(self):
        await self.until(lambda tab: not tab.kept)

    @property
    def places(self):
        return [self.pairs[identity][:2] for identity in self.order]


async def tab_of(address, token="", client=None):
    tab = Tab(address, token, client)
    await tab.connect()
    return tab


OPEN = []


def run(session):
    """Run what tabs do, and close them."""

    async def whole():
        try:
            return await session
        finally:
            for line in OPEN:
                line.close()
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(5):
                        while await line.read_message() is not None:
                            pass
            OPEN.clear()

    return asyncio.run(whole())
