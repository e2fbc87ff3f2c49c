"""What a user is told of a module that solves its problem, for every module of the gallery."""

from __future__ import annotations

import ast

import golden
import pytest

from codegen.solutions.notes import notes


def metadata_of(text: str) -> dict[str, object]:
    """The metadata in the text of a module, and a fault where a key stands there twice."""
    assigned = [n for n in ast.parse(text).body if isinstance(n, ast.Assign)]
    node = next(n.value for n in assigned if ast.unparse(n.targets[0]) == "metadata")
    assert isinstance(node, ast.Dict)
    keys = [ast.literal_eval(key) for key in node.keys if key is not None]
    assert len(keys) == len(set(keys)), sorted(key for key in set(keys) if keys.count(key) > 1)
    value: dict[str, object] = ast.literal_eval(node)
    return value


@pytest.mark.parametrize("name", sorted(golden.names()))
def test_notes_of_every_module_can_be_told(name):
    """As `codegen build` prints them: of phases one ended in a TypeError, for want of such a test."""
    for note in notes(metadata_of(golden.text_of(name))):
        assert isinstance(note, str)
        assert note
