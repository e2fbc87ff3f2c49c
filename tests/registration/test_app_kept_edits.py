"""No edit of the page is ever lost: not by other tabs, a server that dies, a full disk, or another server."""

import asyncio
import json
import os
import resource
import signal
import time

import pytest
from browser import server
from small_pictures import with_pictures

pytest.importorskip("tornado", reason="tornado is not installed")

from tabs import run, tab_of
from typer.testing import CliRunner

from codegen.cli import main
from codegen.registration.app.reading import Store


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return with_pictures(tmp_path_factory.mktemp("server"))


@pytest.fixture(scope="module")
def address(solver, files):
    with server(files / "state", files / "moving.png", files / "fixed.png") as address:
        yield address


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
