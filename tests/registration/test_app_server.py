"""The server of the page without a browser: who is let in, what is bounded, and that no edit is ever lost."""

import asyncio
import contextlib
import http.client
import json
import os
import resource
import signal
import socket
import struct
import time
import uuid
from urllib.parse import urlsplit

import numpy as np
import pytest
from browser import server

pytest.importorskip("tornado", reason="tornado is not installed")

from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.websocket import websocket_connect
from typer.testing import CliRunner

from codegen.cli import main
from codegen.registration.app.autosave import Store
from codegen.registration.app.reading import LIMITS
from codegen.registration.images import write_image

SHAPE = (40, 60)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("server")
    for k, name in enumerate(("moving", "fixed")):
        write_image(folder / f"{name}.png", np.random.default_rng(k).integers(0, 255, SHAPE).astype(np.uint8))
    return folder


@pytest.fixture(scope="module")
def address(solver, files):
    with server(files / "state", files / "moving.png", files / "fixed.png") as address:
        yield address


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


# --- who is let in ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", ["", "main.js", "socket", "nothing"])
@pytest.mark.parametrize(
    "host", ["example.org", "example.org:{port}", "localhost", "localhost.example.org:{port}", None]
)
def test_a_host_that_is_not_this_machine_is_refused(address, path, host):
    host = host and host.format(port=urlsplit(address).port)
    assert ask(address, path, Host=host)[0] in (400, 403)


@pytest.mark.parametrize("name", ["localhost", "127.0.0.1", "[::1]"])
def test_this_machine_is_let_in_by_its_names(address, name):
    status, _, body = ask(address, Host=f"{name}:{urlsplit(address).port}")
    assert status == 200
    assert b"Image registration by landmarks" in body


@pytest.mark.parametrize(
    "origin", ["http://example.org", "http://localhost:1", "https://localhost.example.org", "null"]
)
def test_other_origins_are_refused(address, origin):
    port = urlsplit(address).port
    assert ask(address, Origin=origin)[0] == 403
    upgrade = {
        "Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
    }  # fmt: skip
    assert ask(address, "socket?client=a", **upgrade, Origin=origin)[0] == 403
    assert ask(address, "socket?client=a", **upgrade)[0] == 403
    assert ask(address, "socket?client=a", **upgrade, Origin=f"http://localhost:{port}")[0] == 101
    token = "0" * 32
    assert ask(address, f"work/{token}/example", "POST", b"", Content_Length="0", Origin=origin)[0] == 403
    assert ask(address, f"work/{token}/example", "POST", b"", Content_Length="0")[0] == 403


@pytest.mark.parametrize("path", ["", "style.css", "main.js", "nothing"])
def test_every_answer_forbids_frames_and_foreign_scripts(address, path):
    headers = ask(address, path)[1]
    assert headers["X-Frame-Options"] == "DENY"
    policy = dict(part.split(" ", 1) for part in headers["Content-Security-Policy"].split("; "))
    assert policy["default-src"] == policy["frame-ancestors"] == policy["base-uri"] == "'none'"
    assert policy["script-src"] == policy["style-src"] == "'self'"
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert headers["Referrer-Policy"] == "no-referrer"


def test_the_server_listens_on_this_machine_only_and_serves_no_other_files(address):
    port = urlsplit(address).port
    others = {entry[4][0] for entry in socket.getaddrinfo(socket.gethostname(), port, socket.AF_INET)}
    for host in others - {"127.0.0.1", "127.0.1.1"}:
        with pytest.raises(OSError, match="refused"):
            socket.create_connection((host, port), timeout=5)
    for path in (
        "../../../../etc/passwd", "static/%2e%2e/%2e%2e/pyproject.toml", "%2e%2e/server.py", "moving.png", "state/",
        f"work/{'0' * 32}/tile/{'0' * 64}/0/0/0", "work/../x/tile",
    ):  # fmt: skip
        assert ask(address, path)[0] in (400, 403, 404)


# --- what is bounded --------------------------------------------------------------------------------------------------


def test_uploads_are_bounded_before_they_are_read(address):
    token = run(_token(address))
    own = {"Origin": address.rstrip("/"), "Content_Type": "multipart/form-data; boundary=b"}
    for path, most in ((f"work/{token}/image/moving", LIMITS.bytes), (f"work/{token}/landmarks", 16 << 20)):
        # Nothing of the body is ever sent: the announcement is enough.
        status, _, _ = ask(address, path, "POST", b"", Content_Length=str(most + (1 << 20)), **own)
        assert status in (400, 413)
    status, _, _ = ask(address, f"work/{token}/image/moving", "POST", b"", **own)
    assert status == 411
    chunked = b"5\r\nhello\r\n0\r\n\r\n"
    status, _, _ = ask(address, f"work/{token}/image/moving", "POST", chunked, Transfer_Encoding="chunked", **own)
    assert status == 411


async def _token(address):
    return (await tab_of(address)).token


def form(name, data):
    head = f'--b\r\nContent-Disposition: form-data; name="file"; filename="{name}"\r\n\r\n'.encode()
    return head + data + b"\r\n--b--\r\n"


def send(address, token, name, data, path="image/moving"):
    body = form(name, data)
    own = {"Origin": address.rstrip("/"), "Content_Type": "multipart/form-data; boundary=b"}
    status, _, answer = ask(address, f"work/{token}/{path}", "POST", body, Content_Length=str(len(body)), **own)
    return status, answer


def test_bombs_and_damaged_files_are_refused_and_the_work_goes_on(address, files):
    async def session():
        tab = await tab_of(address)
        await tab.add([5.0, 6.0])
        header = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR" + (60_000).to_bytes(4, "big") * 2 + b"\x08\x02\x00\x00\x00"
        for data in (header + bytes(100), b"", b"no image", (files / "moving.png").read_bytes()[:200]):
            status, answer = await asyncio.to_thread(send, address, tab.token, "<script>.png", data)
            assert status == 422
            assert json.loads(answer)["error"]
        assert (await asyncio.to_thread(send, address, tab.token, "a.csv", b"x,y\n1,2\n", "landmarks"))[0] == 422
        good = (files / "fixed.png").read_bytes()
        assert (await asyncio.to_thread(send, address, tab.token, "<b>&.png", good))[0] == 200
        await tab.until(lambda tab: any(m.get("moving", {}).get("name") == "<b>&.png" for m in tab.heard))
        assert len(tab.order) == 1

    run(session())


@pytest.mark.parametrize(
    "message",
    ["", "[", "null", "[]", "7", '{"type": 5}', '{"type":"edit"}', '{"type":"edit","number":"x"}', "[" * 100_000,
     '{"type":"look","time":"a","window":null,"grid":0}',
     '{"type":"look","time":1,"window":[0,0,1,1,1e9,1e9],"grid":0}',
     '{"type":"edit","number":1,"do":"add","side":"up","place":[1,2]}',
     '{"type":"edit","number":1,"do":"add","side":"moving","place":[NaN,2]}',
     '{"type":"edit","number":1,"do":"add","side":"moving","place":"ab"}',
     '{"type":"edit","number":1,"do":"move","id":{},"side":"moving","place":[1,2],"settled":true}',
     '{"type":"edit","number":1,"do":"set","settings":{"align":"__class__","sigma":1,"scheme":"rk4","interpolation":"a"}}',
     '{"type":"edit","number":1,"do":"__init__"}'],
)  # fmt: skip
def test_messages_that_hold_anything_change_nothing(address, message):
    async def session():
        tab = await tab_of(address)
        await tab.socket.write_message(message)
        tab.number = 5
        await tab.add([7.0, 8.0])
        assert tab.places == [[7.0, 8.0]]

    run(session())


# --- that nothing is lost ---------------------------------------------------------------------------------------------


def test_twenty_sessions_at_once_stay_separate(address):
    async def sessions():
        tabs = [await tab_of(address) for _ in range(20)]
        await asyncio.gather(*(tab.add([5.0 + k, 20.0]) for k, tab in enumerate(tabs)))
        await asyncio.gather(*(tab.add([5.0 + k, 30.0]) for k, tab in enumerate(tabs)))
        await asyncio.gather(*(tab.saved() for tab in tabs))
        for k, tab in enumerate(tabs):
            await tab.until(lambda tab: any(m.get("found") and len(m["residuals"]) == 2 for m in tab.heard))
            assert tab.places == [[5.0 + k, 20.0], [5.0 + k, 30.0]]
        assert len({tab.token for tab in tabs}) == 20

    run(sessions())


def test_tabs_on_one_work_hear_of_each_other_and_each_edit_is_done_once(address):
    async def session():
        one = await tab_of(address)
        other = await tab_of(address, one.token)
        for k in range(10):
            await (one, other)[k % 2].edit("add", side="moving", place=[4.0 + 5 * k, 9.0])
        for tab in (one, other):
            await tab.until(lambda tab: len(tab.order) == 10)
            await tab.saved()
        assert one.pairs == other.pairs
        # The same edit, sent again as after a lost connection, is known.
        await one.socket.write_message(json.dumps({"type": "edit", "number": 1, "do": "add", "side": "moving",
                                                   "place": [1, 1]}))  # fmt: skip
        await one.edit("rename", id=one.order[0], name="first")
        await other.until(lambda tab: tab.pairs[tab.order[0]][4] == "first")
        assert len(other.order) == 10
        one.socket.close()
        again = await tab_of(address, one.token)
        assert again.pairs == other.pairs

    run(session())


def test_a_page_that_never_heard_that_its_edit_was_saved_is_told_when_it_comes_back(address):
    async def session():
        one = await tab_of(address)
        other = await tab_of(address, one.token)
        await one.edit("add", side="moving", place=[4.0, 9.0])
        await other.until(lambda tab: len(tab.order) == 1)
        await other.until(lambda tab: any(message["type"] == "saved" for message in tab.heard[-1:]))
        assert one.kept
        one.socket.close()
        one.greeted = False
        await one.connect()
        await one.saved()
        assert len(one.order) == 1

    run(session())


def killed(files, state, edits, delay):
    """The places that a tab has put, and those that a new server finds, where the first was killed on the way."""

    async def first(address, process):
        tab = await tab_of(address)
        await tab.add([1.0, 1.0])
        await tab.saved()
        for k in range(edits):
            await tab.edit("add", side="moving", place=[2.0 + k / 4, 5.0])
        end = time.monotonic() + delay
        while time.monotonic() < end:
            try:
                await asyncio.wait_for(tab.listen(), end - time.monotonic())
            except (TimeoutError, ConnectionError):
                break
        process.send_signal(signal.SIGKILL)
        return tab

    async def second(address, tab):
        tab.address, tab.greeted = address, False
        await tab.connect()
        await tab.until(lambda tab: len(tab.order) >= edits + 1)
        await tab.saved()
        fresh = await tab_of(address, tab.token)
        return fresh.places

    images = (files / "moving.png", files / "fixed.png")
    with server(state, *images, with_process=True) as (address, process):
        tab = run(first(address, process))
    with server(state, *images) as address:
        return [[1.0, 1.0], *([2.0 + k / 4, 5.0] for k in range(edits))], run(second(address, tab))


@pytest.mark.parametrize("delay", [0.0, 0.02, 0.1])
def test_a_server_that_is_killed_while_it_saves_loses_nothing(solver, files, tmp_path, delay):
    put, found = killed(files, tmp_path / "state", 40, delay)
    assert found == put  # each once, and in their order


def test_a_disk_that_is_full_is_told_of_and_what_was_edited_is_kept(solver, files, tmp_path):
    """A limit on the size of files stands for the disk: the server's writes fail in the middle of a file."""
    if not hasattr(resource, "prlimit"):
        pytest.skip("the limits of another process cannot be set on this system")
    state = tmp_path / "state"

    async def session(address, process):
        tab = await tab_of(address)
        await tab.add([3.0, 4.0])
        await tab.saved()
        _, most = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (100, most))
        await tab.add([5.0, 6.0])
        await tab.until(lambda tab: tab.problem)
        assert "cannot be written" in tab.problem
        assert len(tab.kept) == 1
        assert len(Store(state).load(tab.token).work.pairs) == 1  # the file is as it was
        other = await tab_of(address, tab.token)
        assert other.places == [[3.0, 4.0], [5.0, 6.0]]
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (most, most))
        await tab.send(type="save")
        await tab.saved()
        assert tab.problem is None
        return tab.token

    with server(state, files / "moving.png", files / "fixed.png", with_process=True) as (address, process):
        token = run(session(address, process))
    assert [pair.moving for pair in Store(state).load(token).work.pairs] == [(3.0, 4.0), (5.0, 6.0)]


def test_two_servers_on_one_work_keep_both_states(solver, files, tmp_path):
    images = (files / "moving.png", files / "fixed.png")

    async def session(first, second):
        one = await tab_of(first)
        await one.add([1.0, 2.0])
        await one.saved()
        other = await tab_of(second, one.token)
        await other.add([3.0, 4.0])
        await other.saved()
        await one.add([5.0, 6.0])
        await one.saved()
        assert one.token != other.token
        assert any("changed this work" in text for text in one.said)
        return [(tab.token, tab.places) for tab in (one, other)]

    state = tmp_path / "state"
    with server(state, *images) as first, server(state, *images) as second:
        kept = run(session(first, second))
    for token, places in kept:
        assert [list(pair.moving) for pair in Store(state).load(token).work.pairs] == places


def test_a_state_folder_that_cannot_be_written_is_told_at_the_start_with_the_option(tmp_path):
    (tmp_path / "file").write_text("")
    for command in (["--state", str(tmp_path / "file")], ["--state", str(tmp_path / "file" / "below")]):
        done = CliRunner().invoke(main, ["app", "--no-browser", *command])
        assert done.exit_code == 2
        assert "--state" in str(done.exception or done.output) + done.output


def test_a_folder_without_permission_is_told_of_too(tmp_path):
    if os.geteuid() == 0:
        pytest.skip("the root user may write everywhere")
    tmp_path.chmod(0o500)
    done = CliRunner().invoke(main, ["app", "--no-browser", "--state", str(tmp_path)])
    assert done.exit_code == 2


def test_a_work_that_is_damaged_on_the_disk_is_not_written_over(solver, files, tmp_path):
    state, token = tmp_path / "state", "ab" * 16
    state.mkdir()
    (state / f"{token}.json").write_text("{")

    async def session(address):
        tab = await tab_of(address, token)
        await tab.add([3.0, 4.0])
        await tab.saved()
        return tab.token

    with server(state, files / "moving.png", files / "fixed.png") as address:
        found = run(session(address))
    assert found != token
    assert (state / f"{token}.json").read_text() == "{"


def test_foreign_sockets_get_no_work(address):
    async def session():
        where = urlsplit(address)
        request = HTTPRequest(f"ws://{where.netloc}/socket?client=a", headers={"Origin": "http://example.org"})
        with pytest.raises(HTTPClientError, match="403"):
            await websocket_connect(request)

    run(session())
