"""The errors that a person can cause, each naming what is wrong, where, and the remedy."""

from __future__ import annotations

from codegen.identifiers import plain

INTERRUPTED = "codegen: interrupted; no file was left half written"
"""What a command says when it is interrupted; files are written as a whole or not at all."""


class Interrupted(KeyboardInterrupt):
    """An interrupt of work of which a part stays; its text says how much, and how the rest is done."""


def one_line(text: str, limit: int = 1000) -> str:
    """The text without line breaks, cut where it is very long."""
    line = " ".join(text.split())
    return line if len(line) <= limit else line[:limit] + " ..."


def clause(text: str) -> str:
    """A part of a message on one line, short enough that the rest is seen."""
    return one_line(text, 400)


class CodegenError(Exception):
    """Base of all errors that are reported as one line with exit status 2, never as a traceback.

    Parameters are the finding (naming the symbol, equation or file) and the remedy, both one clause.
    """

    def __init__(self, finding: str, remedy: str) -> None:
        # Whatever generated code calls a quantity, its author reads the name that he gave it.
        self.finding, self.remedy = plain(finding), plain(remedy)
        super().__init__(f"{self.finding}; {self.remedy}")

    def __reduce__(self) -> tuple[type[CodegenError], tuple[str, str]]:
        """What makes the same error in another process, which may have met it first."""
        return type(self), (self.finding, self.remedy)


class ProblemFileError(CodegenError):
    """The problem file cannot be read, imported or called."""


class ArgumentError(CodegenError):
    """A `--set` argument, a scheme, a method, a driver or another option does not fit the problem."""


class SymbolError(CodegenError):
    """A symbol is undeclared, unused, declared twice or badly named."""


class ExpressionError(CodegenError):
    """A Lagrangian, Hamiltonian, force, cost or boundary value cannot be used as it is written."""


class UnitError(CodegenError):
    """A unit is unknown, or units that were given do not agree."""


class DegenerateError(CodegenError):
    """A Legendre transform does not exist because velocities (or momenta) cannot be solved for."""


class SizeError(CodegenError):
    """A problem is too large for what is to be derived from it."""


class BoundaryError(CodegenError):
    """The boundary conditions do not fit the coordinates of the problem."""


class SchemeError(CodegenError):
    """A scheme is unknown, or cannot be applied to this problem or method."""


class ModuleError(CodegenError):
    """A generated module is missing, damaged or does not belong to the problem."""


class FileError(CodegenError):
    """The file system refuses to write a file: no room, no permission, a disk that may only be read."""


class VerificationError(CodegenError):
    """A derivative in an emitted text is not that of the expression; nothing is written."""


class NumericsError(CodegenError):
    """Numbers given at run time are unusable: not finite, of the wrong shape, or out of range."""


class PointsError(CodegenError):
    """A file of points cannot be read, or its points cannot be connected: duplicates, points outside the domain."""


class TableError(CodegenError):
    """A file of a table cannot be read, or its rows are no table: unsorted, twice, missing, not finite."""


class LandmarkError(CodegenError):
    """Landmarks that no map can match: not finite, not as many in both images, or two at one place."""


class RegistrationError(CodegenError):
    """The numerics did not find a map that carries the landmarks where they belong; the finding names the place."""


class ImageError(CodegenError):
    """An array or a file is no image that can be read, warped or written."""


class ExtraError(CodegenError):
    """A library is not installed that an optional part of this package needs; the remedy names the extra."""


class ClusterError(CodegenError):
    """A scheduler of a cluster does not answer, has no workers, or was lost; what chunks have written stays."""
