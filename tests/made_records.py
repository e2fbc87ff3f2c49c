"""Records of modules that tests make up."""

from __future__ import annotations

from typing import Any

from codegen.runtime.record import ConnectRecord, ControlRecord, Form, Method

_FIELDS = {
    "problem": "invented", "title": "Made up.", "inputs": "", "steps": 50, "parameters": {}, "scheme": "midpoint",
    "order": 2, "form": Form.LAGRANGIAN, "coordinates": (), "rates": (),
}  # fmt: skip


def control_record(**given: Any) -> ControlRecord:
    """A record of optimal control with some fields."""
    return ControlRecord(**(_FIELDS | {"method": Method.VARIATIONAL, "node": (), "interval": ()} | given))


def connect_record(**given: Any) -> ConnectRecord:
    """A record of points that are connected with some fields."""
    return ConnectRecord(**(_FIELDS | {"method": Method.STEPPING} | given))
