"""What a registration of volumes from files to files finds."""

from __future__ import annotations

from dataclasses import dataclass

from codegen.registration.jobs import Outcome
from codegen.registration.volumes.blocks import Warped
from codegen.registration.volumes.files import Volume


@dataclass(frozen=True, eq=False, kw_only=True)
class VolumeResult(Outcome):
    """What a job found of volumes, with all that a report shows."""

    moving: Volume
    fixed: Volume | None
    inverse: bool = False
    warped: Warped | None = None

    @property
    def source(self) -> Volume:
        """The volume that is warped."""
        return self.fixed if self.inverse and self.fixed is not None else self.moving

    @property
    def target(self) -> Volume | None:
        """The volume in whose frame the result is, if there is one."""
        return self.moving if self.inverse else self.fixed
