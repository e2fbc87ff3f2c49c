"""Views of many sessions in one process, whose jobs share two threads; no browser."""

import queue
import time

import numpy as np
import pytest

pytest.importorskip("panel", reason="panel is not installed")

from codegen.registration.app import page, solving
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


def test_a_notebook_can_show_the_page():
    session = Session(Picture(np.zeros(SHAPE, np.uint8)))
    shown = page(session=session)
    assert shown.get_root() is not None
    session.click("moving", (3.0, 4.0))
    assert session.work.landmarks().moving.tolist() == [[3.0, 4.0]]
