"""The errors that users can cause; each message states the mistake, its location and the remedy."""

from __future__ import annotations

from collections.abc import Iterable
from numbers import Integral
from typing import TypeGuard

from codegen.identifiers import plain

INTERRUPTED = "codegen: interrupted; no file was left half written"
"""Message of an interrupted command; no file is incomplete, because files are replaced atomically."""


class Interrupted(KeyboardInterrupt):
    """An interrupt of work that can be resumed; its text states what is stored and how to resume."""


def one_line(text: str, limit: int = 1000) -> str:
    """Return the text without line breaks; a text of more than `limit` characters is cut and ends with " ..."."""
    line = " ".join(text.split())
    return line if len(line) <= limit else line[:limit] + " ..."


def clause(text: str) -> str:
    """Return a part of a message without line breaks, cut at 400 characters."""
    return one_line(text, 400)


def nearest(name: object, known: Iterable[str], otherwise: str = "", most: int = 1, cutoff: float = 0.6) -> str:
    """Return the question "did you mean NAME?" with at most so many of the most similar names, or else `otherwise`."""
    import difflib  # slow to import, and not needed without an error

    similar = difflib.get_close_matches(str(name), list(known), most, cutoff)
    return f"did you mean {' or '.join(similar)}?" if similar else otherwise


def is_count(value: object, least: int = 1) -> TypeGuard[int]:
    """Return True for a whole number, but no truth value, that is not smaller than `least`."""
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= least


class CodegenError(Exception):
    """The base class of all errors that commands report as one line with exit status 2, without a traceback.

    `finding` states the mistake, and names the symbol, equation or file. `remedy` states the correction. Each is one
    clause; the message is "finding; remedy".
    """

    def __init__(self, finding: str, remedy: str) -> None:
        # Names of generated code are replaced by the names of the user.
        self.finding, self.remedy = plain(finding), plain(remedy)
        super().__init__(f"{self.finding}; {self.remedy}")

    def __reduce__(self) -> tuple[type[CodegenError], tuple[str, str]]:
        """Return the class and the two arguments, from which a pickle restores the error."""
        return type(self), (self.finding, self.remedy)


class ProblemFileError(CodegenError):
    """The problem file cannot be read, imported or called."""


class ArgumentError(CodegenError):
    """A `--set` argument, a scheme, a method, a driver or another option does not fit the problem."""


class SymbolError(CodegenError):
    """A symbol is undeclared, unused, declared twice or badly named."""


class ExpressionError(CodegenError):
    """A Lagrangian, Hamiltonian, force, cost or boundary value is unusable."""


class UnitError(CodegenError):
    """A unit is unknown, or declared units are inconsistent."""


class DegenerateError(CodegenError):
    """A Legendre transform does not exist, because its equations have no unique solution for velocities or momenta."""


class SizeError(CodegenError):
    """A problem is too large: the derivation of its equations would take too long."""


class BoundaryError(CodegenError):
    """The boundary conditions do not fit the coordinates of the problem."""


class SchemeError(CodegenError):
    """A scheme is unknown, or cannot be applied to this problem or method."""


class ModuleError(CodegenError):
    """A generated module is missing, damaged or does not belong to the problem."""


class FileError(CodegenError):
    """The file system refuses to write a file: no space, no permission, a read-only disk."""


class VerificationError(CodegenError):
    """A derivative in the text of a module differs from the derivative of the expression; no module is written."""


class NumericsError(CodegenError):
    """Numbers given at run time are unusable: not finite, of the wrong shape, or out of range."""


class PointsError(CodegenError):
    """A file of points is unreadable, or its points cannot be connected: duplicates, points outside the domain."""


class TableError(CodegenError):
    """A file of a table is unreadable, or its rows are unsorted, repeated, missing or not finite."""


class LandmarkError(CodegenError):
    """Landmarks that no map can match: not finite, different numbers in both images, or two at the same position."""


class RegistrationError(CodegenError):
    """The solver found no map that matches the landmarks; the finding names the position."""


class ImageError(CodegenError):
    """An array or a file is no image, or cannot be read, warped or written."""


class ExtraError(CodegenError):
    """A package of an optional part is not installed; the remedy names the extra."""


class DeviceError(CodegenError):
    """There is no GPU, numba cannot use it, or its memory does not suffice."""


class ClusterError(CodegenError):
    """The scheduler of a cluster does not answer, has no workers, or was lost; chunks that are written remain."""
