"""What a user is told of a module that solves its problem, for every module of the gallery."""

from __future__ import annotations

import golden
import pytest

from codegen.solving.results.output import notes, record_in


@pytest.mark.parametrize("name", sorted(golden.names()))
def test_notes_of_every_module_can_be_told(name):
    """As `codegen build` prints them: of phases one ended in a TypeError, for want of such a test."""
    for note in notes(record_in(golden.text_of(name))):
        assert isinstance(note, str)
        assert note
