"""From a problem file, or an object, to a checked model, or to one line that says what is wrong."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from codegen.discretise.model.definitions import Model
from codegen.discretise.model.pairwise import PairwiseModel, is_pairwise, normalise_pairwise
from codegen.discretise.model.phases import normalise
from codegen.errors import CodegenError
from codegen.problem.sources import Source, source_of, with_location


def load_problem(problem: Source | Path | str, arguments: Mapping[str, str] = {}) -> Model | PairwiseModel:
    """Run a problem file's `problem(...)` with the given `--set` arguments, and check and normalise what it returns.

    The model is named after the file and titled by the first line of its docstring; of an object its source has both.
    Raises ProblemFileError when the file cannot be read, imported or called; ArgumentError when an argument does not
    fit `problem`; another CodegenError when the problem is not well posed. All name the file or the object, in one
    line.
    """
    source = source_of(problem)
    title, written, declared = source.written(arguments)
    try:
        if is_pairwise(written):
            return normalise_pairwise(written, declared, name=source.name, title=title)
        return normalise(written, declared, name=source.name, title=title)
    except CodegenError as error:
        raise with_location(error, source.location) from error
