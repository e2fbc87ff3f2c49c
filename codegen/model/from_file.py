"""From a problem file to a checked model, or to one line that says what is wrong."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from codegen.author.problem_file import with_location, written_problem
from codegen.errors import CodegenError
from codegen.model.definitions import Model
from codegen.model.pairwise import PairwiseModel, is_pairwise, normalise_pairwise
from codegen.model.phases import normalise


def load_problem(path: Path | str, arguments: Mapping[str, str] = {}) -> Model | PairwiseModel:
    """Run a problem file's `problem(...)` with the given `--set` arguments, and check and normalise what it returns.

    The model is named after the file and titled by the first line of its docstring. Raises ProblemFileError when the
    file cannot be read, imported or called; ArgumentError when an argument does not fit `problem`; another CodegenError
    when the problem is not well posed. All name the file, in one line.
    """
    path = Path(path)
    title, problem, declared = written_problem(path, arguments)
    try:
        if is_pairwise(problem):
            return normalise_pairwise(problem, declared, name=path.stem, title=title)
        return normalise(problem, declared, name=path.stem, title=title)
    except CodegenError as error:
        raise with_location(error, str(path)) from error
