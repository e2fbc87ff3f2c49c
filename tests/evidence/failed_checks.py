"""What a check finds wrong."""

from __future__ import annotations

from codegen.evidence import checks


def failures(name, context):
    return [finding for finding in checks.apply(name, context) if not finding.passed]
