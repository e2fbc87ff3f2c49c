"""Views of many sessions in one process, whose jobs share two threads; no browser."""

import queue
import time
from concurrent.futures import Future

import numpy as np
import pytest

pytest.importorskip("panel", reason="panel is not installed")

from codegen.errors import ModuleError
from codegen.registration.app import page, preparing, solving
from codegen.registration.app.picture import Picture
from codegen.registration.app.session import Session
from codegen.registration.app.view import View

SHAPE = (30, 40)
# Bokeh's own use of pandas.
pytestmark = pytest.mark.filterwarnings("ignore:The inplace keyword in DataFrame")


class Visitor:
    """A view, and the thread of its session: the test's own."""

    def __init__(self, seed):
        self.acts = queue.Queue()
        pixels = np.random.default_rng(seed).integers(0, 255, SHAPE).astype(np.uint8)
        self.view = View(Session(Picture(pixels)), self.acts.put)

    def click(self, side, x, y):
        """What the browser sends after a click."""
        source = self.view.canvases[side].points.source
        click = {"x": x, "y": y, "id": 0, "edition": 0}
        source.data = {name: [*column, click.get(name, 0)] for name, column in source.data.items()}

    def wait(self, what, seconds=60.0):
        end = time.monotonic() + seconds
        while not what(self.view):
            try:
                self.acts.get(timeout=max(0.0, end - time.monotonic()))()
            except queue.Empty:
                pytest.fail("nothing happened")


def certified(view):
    return view.certified is not None and view.certified.revision == view.session.revision


def test_ten_sessions_at_once_stay_separate(solver):
    visitors = [Visitor(k) for k in range(10)]
    for k, visitor in enumerate(visitors):
        visitor.click("moving", 5.0 + k, 10.0)
        visitor.click("moving", 5.0 + k, 20.0)
    for k, visitor in enumerate(visitors):
        visitor.wait(lambda view: len(view.session.work.pairs) == 2)
        visitor.click("fixed", 6.0 + k, 21.0)
        visitor.wait(lambda view: view.session.work.pairs[1].guessed is None)
        visitor.wait(certified)
    for k, visitor in enumerate(visitors):
        view = visitor.view
        assert [pair.moving for pair in view.session.work.pairs] == [(5.0 + k, 10.0), (5.0 + k, 20.0)]
        assert view.session.work.pairs[1].fixed == (6.0 + k, 21.0)
        np.testing.assert_array_equal(view.shown.registration.pairs.fixed[1], [6.0 + k, 21.0])
        assert list(view.controls.table.value["moving_x"]) == [5.0 + k] * 2


@pytest.mark.parametrize("wanted", [True, False])
def test_points_that_are_not_wanted_stay_hidden_whatever_is_drawn(wanted):
    result = Visitor(0).view.result
    result.show_points(wanted)
    for moment in (1.0, 0.5, 1.0, 1.0):
        result.show_carried(np.array([[3.0, 4.0]]), moment)
        assert {renderer.visible for renderer in result.point_renderers} == {wanted and moment == 1.0}
        assert len(result.carried.data["x"]) == (moment < 1.0)


@pytest.mark.parametrize("error", [RuntimeError("<b>"), ZeroDivisionError(), MemoryError()])
def test_whatever_fails_is_shown_and_the_session_goes_on(solver, monkeypatch, error, capfd):
    visitor = Visitor(0)
    visitor.wait(lambda view: view.shown is not None)

    def fail(*arguments):
        raise error

    with monkeypatch.context() as patched:
        patched.setattr(solving, "shown", fail)
        visitor.click("moving", 7.0, 8.0)
        visitor.wait(lambda view: "unexpected" in view.layout.root[4].object)
    assert type(error).__name__ in capfd.readouterr().err
    visitor.click("moving", 20.0, 20.0)
    visitor.wait(lambda view: view.shown.registration is not None and len(view.shown.registration.pairs) == 2)
    assert visitor.view.layout.root[4].object == ""


def test_a_notebook_can_show_the_page_which_solves_without_a_server(solver):
    """What a cell does, in plain Python: the page, its models, and what the kernel then does to the session."""
    session = Session(Picture(np.zeros(SHAPE, np.uint8)))
    session.click("moving", (3.0, 4.0))
    session.click("fixed", (5.0, 6.0))
    shown = page(session=session)
    assert shown.get_root() is not None
    end = time.monotonic() + 60.0
    while session.registration is None:
        assert time.monotonic() < end
        time.sleep(0.05)
    np.testing.assert_allclose(session.registration.map_points([[3.0, 4.0]]), [[5.0, 6.0]], atol=1e-6)


def test_while_the_solver_is_compiled_points_can_be_set_and_then_they_are_solved(solver, monkeypatch):
    awaited = Future()
    monkeypatch.setattr(preparing, "prepared", lambda scheme: awaited)
    visitor = Visitor(0)
    visitor.click("moving", 10.0, 12.0)
    visitor.wait(lambda view: view.shown is not None and view.shown.wanted.waiting)
    view = visitor.view
    assert preparing.COMPILING in view.layout.line
    assert view.shown.registration is None
    assert view.canvases["fixed"].points.source.data["id"] == [1]
    view.export("warped_image")
    visitor.wait(lambda view: "still being compiled" in view.layout.root[4].object)
    awaited.set_result(None)
    visitor.wait(certified)
    assert preparing.COMPILING not in view.layout.line
    np.testing.assert_array_equal(view.shown.registration.pairs.moving, [[10.0, 12.0]])


def test_a_solver_that_cannot_be_compiled_is_reported_where_it_is_needed(monkeypatch):
    with pytest.raises(ModuleError, match="no-such-scheme") as refused:
        preparing.compile_elsewhere("no-such-scheme")
    failed = Future()
    failed.set_exception(refused.value)
    monkeypatch.setattr(preparing, "prepared", lambda scheme: failed)
    visitor = Visitor(0)
    visitor.click("moving", 10.0, 12.0)
    visitor.wait(lambda view: "no-such-scheme" in view.layout.root[4].object)
    assert len(visitor.view.session.work.pairs) == 1
