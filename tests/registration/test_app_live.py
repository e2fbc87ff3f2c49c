"""Works that are open, with lines to tabs that are no browser's; their jobs share the threads of one process."""

import queue
import time
from concurrent.futures import Future
from contextlib import suppress

import numpy as np
import pytest

pytest.importorskip("tornado", reason="tornado is not installed")

from codegen.errors import ModuleError
from codegen.registration.app import page, solving, worker
from codegen.registration.app.live import LiveWork, Works
from codegen.registration.app.reading import Store
from codegen.registration.app.session import Picture, Session

SHAPE = (30, 40)
WINDOW = [0.0, 0.0, 40.0, 30.0, 40, 30]


class Visitor:
    """A work with one tab; the thread of the session is the test's own."""

    def __init__(self, seed=0, **values):
        self.acts, self.heard, self.number = queue.Queue(), [], 0
        pixels = np.random.default_rng(seed).integers(0, 255, SHAPE).astype(np.uint8)
        self.work = LiveWork(Session(Picture(pixels)), self.acts.put, **values)
        self.work.join("tab", self)

    def send(self, message):
        self.heard.append(message)

    def edit(self, do, **values):
        self.number += 1
        self.work.hear("tab", {"type": "edit", "number": self.number, "do": do, **values})

    def add(self, side, x, y):
        self.edit("add", side=side, place=[x, y])

    def said(self, kind):
        return [message for message in self.heard if isinstance(message, dict) and message["type"] == kind]

    def wait(self, what, seconds=60.0):
        end = time.monotonic() + seconds
        while not what():
            try:
                self.acts.get(timeout=max(0.0, end - time.monotonic()))()
            except queue.Empty:
                pytest.fail("nothing happened")


def is_certified(visitor):
    work = visitor.work
    return lambda: work.certified is not None and work.certified.revision == work.session.revision


def test_a_tab_is_told_what_changed_and_what_was_found(solver):
    visitor = Visitor()
    visitor.work.hear("tab", {"type": "look", "time": 1.0, "grid": True, "window": WINDOW})
    visitor.add("moving", 5.0, 10.0)
    visitor.add("moving", 9.0, 20.0)
    assert visitor.said("work")[-1]["changed"][0][:3] == [2, 9.0, 20.0]  # only what is new
    visitor.wait(is_certified(visitor))
    told = visitor.said("solved")[-1]
    assert set(told["residuals"]) == {"1", "2"}
    assert np.shape(told["chart"]["moving"]) == (solving.CHART, solving.CHART, 2)
    assert any(isinstance(message, bytes) for message in visitor.heard)
    visitor.edit("activate", ids=[1], active=False)
    visitor.wait(lambda: set(visitor.said("solved")[-1]["residuals"]) == {"2"})


def test_pictures_that_a_slow_tab_has_not_drawn_do_not_pile_up(solver):
    visitor = Visitor()
    count = lambda: sum(isinstance(message, bytes) and b'"frame"' in message[:200] for message in visitor.heard)  # noqa: E731
    for k in range(5):
        visitor.work.hear("tab", {"type": "look", "time": k / 4, "grid": False, "window": WINDOW})
        visitor.wait(lambda k=k: visitor.work.shown and visitor.work.shown.seen["tab"].look.time == k / 4)
    assert count() == 1
    visitor.work.hear("tab", {"type": "drawn", "number": 1})
    assert count() == 2
    assert b'"time": 1.0' in visitor.heard[-1]  # the newest


@pytest.mark.parametrize("error", [RuntimeError("<b>"), ZeroDivisionError(), MemoryError()])
def test_whatever_fails_is_shown_and_the_session_goes_on(solver, monkeypatch, error, capfd):
    visitor = Visitor()
    visitor.wait(lambda: visitor.work.shown is not None)

    def fail(*arguments):
        raise error

    with monkeypatch.context() as patched:
        patched.setattr(solving, "shown", fail)
        visitor.add("moving", 7.0, 8.0)
        visitor.wait(lambda: any("unexpected" in message["text"] for message in visitor.said("message")))
    assert type(error).__name__ in capfd.readouterr().err
    visitor.add("moving", 20.0, 20.0)
    visitor.wait(
        lambda: visitor.work.shown.registration is not None and len(visitor.work.shown.registration.pairs) == 2
    )
    assert visitor.said("message")[-1]["text"] == ""


def test_a_notebook_can_show_the_page_and_reads_the_session(solver):
    """What a cell does, in plain Python: the page shows itself, and what its server does reaches the session."""
    session = Session(Picture(np.zeros(SHAPE, np.uint8)))
    session.add("moving", (3.0, 4.0))
    session.move(1, "fixed", (5.0, 6.0))
    shown = page(session=session)
    assert shown.address in shown._repr_html_()
    end = time.monotonic() + 60.0
    while session.registration is None:
        assert time.monotonic() < end
        time.sleep(0.05)
    np.testing.assert_allclose(session.registration.map_points([[3.0, 4.0]]), [[5.0, 6.0]], atol=1e-6)
    shown.close()


def test_while_the_solver_is_compiled_points_can_be_set_and_then_they_are_solved(solver, monkeypatch):
    awaited = Future()
    monkeypatch.setattr(worker, "prepared", lambda scheme: awaited)
    visitor = Visitor()
    visitor.add("moving", 10.0, 12.0)
    visitor.wait(lambda: visitor.work.shown is not None and visitor.work.shown.wanted.waiting)
    assert visitor.said("status")[-1]["doing"] == worker.COMPILING
    assert visitor.work.shown.registration is None
    with pytest.raises(Exception, match="still being compiled"):
        visitor.work.require_solver()
    awaited.set_result(None)
    visitor.wait(is_certified(visitor))
    assert visitor.said("status")[-1]["doing"] == ""
    np.testing.assert_array_equal(visitor.work.shown.registration.pairs.moving, [[10.0, 12.0]])


def test_a_solver_that_cannot_be_compiled_is_reported_where_it_is_needed(monkeypatch):
    with pytest.raises(ModuleError, match="no-such-scheme") as refused:
        worker.compile_elsewhere("no-such-scheme")
    failed = Future()
    failed.set_exception(refused.value)
    monkeypatch.setattr(worker, "prepared", lambda scheme: failed)
    visitor = Visitor()
    visitor.add("moving", 10.0, 12.0)
    visitor.wait(lambda: any("no-such-scheme" in message["text"] for message in visitor.said("message")))
    assert len(visitor.work.session.work.pairs) == 1


def test_works_without_tabs_are_closed_once_nothing_of_them_is_unsaved(solver, tmp_path):
    acts, later = queue.Queue(), []
    pixels = np.zeros(SHAPE, np.uint8)
    works = Works(
        lambda: Session(Picture(pixels)), acts.put, lambda _, act: later.append(act), Store(tmp_path / "state")
    )
    visitor = Visitor()
    work = works.get("")
    work.join("tab", visitor)
    (tmp_path / "state").write_text("no folder")
    work.hear("tab", {"type": "edit", "number": 1, "do": "rename", "id": 1, "name": "a"})

    def until(what):
        end = time.monotonic() + 60.0
        while not what():
            assert time.monotonic() < end, "nothing happened"
            with suppress(queue.Empty):
                acts.get(timeout=0.05)()

    until(lambda: any(message["problem"] for message in visitor.said("saved")))
    work.leave("tab", visitor)
    works.left(work)
    later.pop()()
    assert works.find(work.token) is work  # it could not be saved, and whoever comes back finds it
    (tmp_path / "state").unlink()
    work.save()
    until(lambda: not work.busy)
    later.pop()()
    assert works.find(work.token) is None
