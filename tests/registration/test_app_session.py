"""The page's session without a page: pairs, and their history."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_pictures import picture, two_pictures

from codegen.errors import LandmarkError
from codegen.registration.app.session import MOST_PAIRS, History, Settings, Work
from codegen.registration.pairs import LandmarkPairs


@pytest.fixture
def session():
    return two_pictures()


def places(session, side):
    return [pair.at(side) for pair in session.work.pairs]


def test_a_click_adds_a_pair_and_a_click_in_the_other_image_places_its_partner(session):
    pair = session.add("moving", (10.0, 20.0))
    # Without a registration the partner is expected at the same share of the image, counted from its edges.
    assert places(session, "fixed") == [((10.5 * 70 / 60) - 0.5, (20.5 * 50 / 40) - 0.5)]
    assert session.work.pairs[0].guessed == "fixed"
    session.add("fixed", (12.0, 22.0), awaiting=pair.identity)
    assert (places(session, "moving"), places(session, "fixed")) == ([(10.0, 20.0)], [(12.0, 22.0)])
    session.add("fixed", (30.0, 30.0), awaiting=pair.identity)
    assert len(session.work.pairs) == 2
    assert session.work.pairs[1].guessed == "moving"


def test_undo_and_redo_restore_every_state_in_order(session):
    session.add("moving", (10.0, 20.0))
    first = session.work.pairs[0].identity
    for x in (11.0, 12.0, 13.0):
        session.move(first, "moving", (x, 20.0), settled=False)
    session.history.settle()
    session.move(first, "moving", (14.0, 20.0))
    session.set(Settings(sigma=2.0))
    session.remove(first)
    seen = [session.work]
    while session.undo():
        seen.append(session.work)
    assert [len(work.pairs) for work in seen] == [0, 1, 1, 1, 1, 0]
    assert [work.pairs[0].moving[0] for work in seen[1:5]] == [14.0, 14.0, 13.0, 10.0]
    assert seen[1].settings.sigma == 2.0
    assert seen[2].settings.sigma == 0.0
    for work in reversed(seen[:-1]):
        assert session.redo()
        assert session.work == work
    assert not session.redo()


@given(st.lists(st.sampled_from(["change", "gesture", "settle", "undo", "redo"]), max_size=60))
def test_history_agrees_with_a_list_and_a_position(actions):
    history, states, at, gesture = History(0), [0], 0, None
    for count, action in enumerate(actions, 1):
        if action == "change" or (action == "gesture" and gesture != "drag"):
            states, at = [*states[: at + 1], count], at + 1
            gesture = "drag" if action == "gesture" else None
            history.change(count, gesture)
        elif action == "gesture":
            states = [*states[:at], count]
            history.change(count, "drag")
        else:
            gesture = None
            at = at - (action == "undo" and at > 0) + (action == "redo" and at + 1 < len(states))
            getattr(history, action)()
        assert history.present == states[at]
        assert (history.can_undo, history.can_redo) == (at > 0, at + 1 < len(states))


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_places_that_are_no_numbers_are_refused(session, bad):
    pair = session.add("moving", (10.0, 20.0))
    for act in (lambda: session.add("moving", (bad, 3.0)), lambda: session.move(pair.identity, "fixed", (3.0, bad))):
        with pytest.raises(LandmarkError, match="finite"):
            act()
    assert session.work.pairs == (pair,)


def test_names_and_activity_are_edited_and_undone(session):
    first, second = (session.add("moving", (x, 20.0)) for x in (10.0, 30.0))
    session.rename(first.identity, "  left \n eye ")
    session.activate([second.identity], False)
    assert [(pair.name, pair.active) for pair in session.work.pairs] == [("left eye", True), ("", False)]
    assert session.work.landmarks().names == ("left eye",)
    assert session.task().work.active == (session.work.pairs[0],)
    session.undo()
    session.undo()
    assert [(pair.name, pair.active) for pair in session.work.pairs] == [("", True), ("", True)]
    session.activate([first.identity], False)
    assert session.work.landmarks().names == ("2",)  # its number among all pairs, which the table shows


def test_points_stay_within_the_image_and_their_number_within_bounds(session):
    session.add("moving", (-500.0, 1e9))
    assert places(session, "moving") == [(-0.5, 39.5)]
    crowd = np.random.default_rng(0).random((MOST_PAIRS + 1, 2))
    with pytest.raises(LandmarkError, match=str(MOST_PAIRS + 1)):
        session.load(LandmarkPairs(crowd, crowd))
    session.load(LandmarkPairs(crowd[1:], crowd[1:]))
    with pytest.raises(LandmarkError, match=str(MOST_PAIRS)):
        session.add("moving", (3.0, 3.0))


def test_another_image_keeps_the_pairs_that_fit_into_it(session):
    for x in (10.0, 50.0):
        session.add("moving", (x, 20.0))
    session.open("moving", picture((40, 30)))
    assert places(session, "moving") == [(10.0, 20.0)]
    assert not session.history.can_undo
    session.replace(picture((20, 20)), None, Work(settings=session.work.settings))
    assert session.work.pairs == ()
    assert session.picture("fixed") is session.moving
