"""Cases of stress that tests of its parts share."""

from __future__ import annotations

from functools import cache

from codegen.evidence.stress.cases import Case
from codegen.evidence.stress.families import all_cases
from codegen.evidence.stress.motions import VERLET, setup

every_case = cache(all_cases)
PLAIN = Case("plain", "stiff", setup("oscillator", VERLET), "accurate", "a test", bound=1e-3)
