"""Statements of the thesis, with the commands and functions that measure them."""

from thesis.control import MOTIONS
from thesis.errata import ERRATA
from thesis.landmarks import REGISTRATIONS

ENTRIES = {entry.name: entry for entry in (*MOTIONS, *REGISTRATIONS, *ERRATA)}
"""All figures, tables, claims, open questions and errata by name."""
