"""What a solution shows of itself, and as what else it can be had; figures are made by parts of higher floors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from codegen.solutions.comparison import differences, same
from codegen.solutions.datasets import as_dataset, as_frame
from codegen.tasks import Home

if TYPE_CHECKING:
    from xarray import Dataset

    from codegen.plots.picture import Film, Picture

_PICTURE, _FILM = Home("notebooks.solution", "picture"), Home("notebooks.solution", "film")
_HTML = Home("notebooks.solution", "html")


@dataclass(frozen=True)
class Background:
    """Where a solution comes from, as far as its pictures need that: the module, and what its author has written.

    `module` is the loaded one, which a pickle leaves out; then it is loaded again from `path`. `source` is a problem
    file or an object with its `arguments`; a pickle leaves an object out that cannot be pickled, and the drawing in its
    pictures with it.
    """

    module: Any
    path: Path | None = None
    source: Any = None
    arguments: Mapping[str, str] = field(default_factory=dict)

    def __getstate__(self) -> dict[str, Any]:
        import pickle

        source = self.source
        try:
            pickle.dumps(source)
        except Exception:  # functions of an author may have no name by which another process finds them
            source = None
        return {"module": None, "path": self.path, "source": source, "arguments": dict(self.arguments)}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        for name, value in state.items():
            object.__setattr__(self, name, value)


class Display:
    """What `codegen.solve` returns can do beside holding numbers."""

    def __eq__(self, other: object) -> bool:
        """Whether all is the same to the last bit, but for how long it took."""
        return same(self, other) if type(other) is type(self) else NotImplemented

    __hash__ = None  # type: ignore[assignment]  # arrays can be changed

    def differences(self, other: Any) -> dict[str, float]:
        """How far another solution of the problem is away: the max-norm by name, in the units of each quantity.

        On other grids it is interpolated at the nodes of this one, linearly; controls are compared at their own times;
        `t` is the difference of durations. Raises ArgumentError for a solution with other quantities.
        """
        return differences(cast(Any, self), other)

    def to_dataset(self) -> Dataset:
        """An xarray.Dataset with the dimensions node, interval and stage, called as those of a sweep.

        `t` (node), `q` (node, coordinate), `p` (node, momentum), `u` and `multipliers` on nodes, intervals or stages,
        `energy` (node) of a simulation, `cost` and `residual`; the rest are attributes. In the units of the problem,
        which stand, where its author gave them, in `coordinate_unit`, `momentum_unit`, `control_unit` and attributes.
        Raises ExtraError without xarray, and ArgumentError for particles.
        """
        return as_dataset(cast(Any, self))

    def to_frame(self) -> Any:
        """A pandas.DataFrame with a row for each node, indexed by its time, and a column for each quantity by name.

        A control that is constant on intervals has the value that holds from the node on, at the last node that of the
        last interval. In the units of the problem, which `attrs["units"]` names where its author gave them. Raises
        ExtraError without pandas, and ArgumentError for particles.
        """
        return as_frame(cast(Any, self))

    def plot(self, path: Path | str | None = None, *, style: str = "page") -> Picture:
        """The figure of `codegen solve --plot`, which a notebook shows, written to `path` as well if that is given.

        Its `figure` is matplotlib's, and its `text` says what it shows. `style` is "page", "paper" for the width of a
        journal's two columns, or "talk". Raises ArgumentError for another style, for a file that is no .png, .pdf or
        .svg, and for a solution that does not know its module.
        """
        picture: Picture = _PICTURE(self, style)
        if path is not None:
            picture.save(path)
        return picture

    def animate(self, path: Path | str | None = None) -> Film:
        """The film of `codegen solve --animate`, which a notebook shows, written to `path` as well if that is given.

        Raises ArgumentError for a problem without a drawing, and for a file that is no .gif or .mp4.
        """
        film: Film = _FILM(self)
        if path is not None:
            film.save(path)
        return film

    def _repr_html_(self) -> str:
        return str(_HTML(self))
