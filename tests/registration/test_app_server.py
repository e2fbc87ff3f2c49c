"""The server of the page without a browser: who is let in, and what is bounded."""

import asyncio
import json
import socket
from urllib.parse import urlsplit

import pytest
from browser import server
from small_pictures import with_pictures

pytest.importorskip("tornado", reason="tornado is not installed")

from tabs import ask, run, tab_of
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.websocket import websocket_connect

from codegen.registration.app.reading import LIMITS


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return with_pictures(tmp_path_factory.mktemp("server"))


@pytest.fixture(scope="module")
def address(solver, files):
    with server(files / "state", files / "moving.png", files / "fixed.png") as address:
        yield address


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


def test_foreign_sockets_get_no_work(address):
    async def session():
        where = urlsplit(address)
        request = HTTPRequest(f"ws://{where.netloc}/socket?client=a", headers={"Origin": "http://example.org"})
        with pytest.raises(HTTPClientError, match="403"):
            await websocket_connect(request)

    run(session())


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
