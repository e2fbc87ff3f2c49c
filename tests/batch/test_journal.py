"""Journals: what was noted is read again, whatever cut the last line off, and other files are refused."""

from __future__ import annotations

import json

import pytest

from codegen.errors import ArgumentError
from codegen.files import journal_of, new_journal, read_journal

HEADER = {"sweep": "0123", "chunk": 20}
RECORDS = [{"number": 3, "counts": {"solved": 20}}, {"number": 0, "counts": {"solved": 19, "stalled": 1}}]


@pytest.fixture
def path(tmp_path):
    """A journal with two records."""
    begun = new_journal(journal_of(tmp_path / "s.zarr"), HEADER)
    begun.add(RECORDS[:1])
    begun.add(RECORDS[1:])
    return begun.path


def read(path):
    return read_journal(path, "sweep", "0123", "begin anew")


def test_what_was_noted_is_read_again(path):
    assert path.name == "s.zarr.journal"
    found = read(path)
    assert (found.header, found.records) == (HEADER, tuple(RECORDS))


@pytest.mark.parametrize("kept", range(1, 8))
def test_a_line_that_was_cut_off_counts_for_nothing_and_the_next_does_not_go_on_in_it(path, kept):
    whole = path.read_bytes()
    path.write_bytes(whole + json.dumps({"number": 7}).encode()[:kept])
    found = read(path)
    assert found.records == tuple(RECORDS)
    assert path.read_bytes() == whole
    found.add([{"number": 8}])
    assert read(path).records == (*RECORDS, {"number": 8})


def test_that_of_other_work_is_refused(path):
    with pytest.raises(ArgumentError, match="tells of another sweep; begin anew"):
        read_journal(path, "sweep", "4567", "begin anew")
    with pytest.raises(ArgumentError, match="tells of another batch"):
        read_journal(path, "batch", "0123", "begin anew")


@pytest.mark.parametrize("text", ["", "{", "[1]\n", "3\n", "nothing\n", '{"sweep": "0123"}\n}\n'])
def test_what_is_no_journal_is_refused(path, text):
    path.write_text(text)
    with pytest.raises(ArgumentError, match="is damaged"):
        read(path)
    assert path.read_text() == text


def test_what_cannot_be_read_is_refused(path, tmp_path):
    with pytest.raises(ArgumentError, match="cannot be read"):
        read(tmp_path / "none.journal")
    path.write_bytes(b"\xff\xfe\n")
    with pytest.raises(ArgumentError, match="cannot be read"):
        read(path)
