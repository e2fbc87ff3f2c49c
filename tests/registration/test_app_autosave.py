"""Saved work of the page: what comes back, what is never written over, what is deleted in time."""

import json

import numpy as np
import pytest
from small_pictures import picture, two_pictures

from codegen.registration.app.reading import MOST_WORKS, OtherWriterError, Saved, Store, new_token
from codegen.registration.app.session import Settings, Work


@pytest.fixture
def session():
    return two_pictures()


def kept(session, work=None, heard=None, edition=""):
    return Saved(session.moving, session.fixed, session.work if work is None else work, heard or {}, edition)


def test_saved_work_comes_back_and_nothing_else_is_ever_read(tmp_path, session):
    store, token = Store(tmp_path / "state"), new_token()
    store.require_writable()
    first = session.add("moving", (10.25, 20.5))
    session.add("fixed", (30.0, 20.0))
    session.remove(first.identity)
    session.activate([2], False)
    session.set(Settings("affine", 1.5, "midpoint", "cubic"))
    store.save(token, kept(session, heard={"tab": 7}))
    saved = store.load(token)
    assert saved.work == session.work
    assert saved.heard == {"tab": 7}
    np.testing.assert_array_equal(saved.fixed.pixels, session.fixed.pixels)
    (tmp_path / "secret.json").write_text((store.folder / f"{token}.json").read_text())
    assert store.load("../secret") is None
    record = json.loads((store.folder / f"{token}.json").read_text())
    twice = record["pairs"] * 2
    for damage in ({"moving": {"digest": "../secret.json", "name": "a"}}, {"pairs": [["a"]]}, {"settings": 3},
                   {"heard": 3}, {"pairs": twice}):  # fmt: skip
        (store.folder / f"{token}.json").write_text(json.dumps(record | damage))
        assert store.load(token) is None
    (store.folder / f"{token}.json").write_text("{")
    assert store.load(token) is None


def test_a_work_that_somebody_else_has_written_is_not_written_over(tmp_path, session):
    store, token = Store(tmp_path), new_token()
    mine = store.save(token, kept(session))
    session.add("moving", (10.0, 20.0))
    theirs = store.save(token, kept(session, edition=mine.edition))
    with pytest.raises(OtherWriterError):
        store.save(token, kept(session, Work(), edition=mine.edition))
    assert store.load(token).work == session.work
    assert store.load(token).edition == theirs.edition


def test_old_works_are_deleted_with_their_images(tmp_path, session):
    store, shared = Store(tmp_path), session.fixed
    lone = picture((8, 8))
    store.save(new_token(), Saved(lone, shared, Work(), {}, ""))
    for _ in range(MOST_WORKS):
        store.save(new_token(), kept(session, Work()))
    assert len(list(tmp_path.glob("*.json"))) == MOST_WORKS
    assert not (tmp_path / lone.digest).exists()
    assert (tmp_path / shared.digest).exists()
