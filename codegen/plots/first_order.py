"""What sensitivities of one case predict of all samples, to first order: means, and standard deviations.

The case is the one that is nearest to the mean of what varies. Its slopes times the deviations of quantities that are
sampled independently of each other add up by squares; those of a table may follow each other, so that their
covariances take part. Source: JCGM 100 (2008), Guide to the expression of uncertainty in measurement, section 5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from codegen.plots.style import statuses

if TYPE_CHECKING:
    from xarray import Dataset

NORMAL_90 = 1.6448536269514722
"""Within so many standard deviations a normal distribution has 90 % of its values."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """The case `centre` whose slopes predict, the places of varied quantities among them, and how these are spread.

    `offset` (m,) is the mean of m quantities less their values in that case, `covariance` (m, m) that of their samples.
    """

    centre: int
    by: list[int]
    offset: NDArray[np.float64]
    covariance: NDArray[np.float64]

    def of(self, data: Dataset, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The mean and the standard deviation (...) of a variable (case, ...) that has derivatives."""
        centre = np.asarray(data[name].isel(case=self.centre).values, dtype=float)
        slopes = np.asarray(data[f"d_{name}"].isel(case=self.centre).values, dtype=float)[self.by]
        mean = centre + np.tensordot(self.offset, slopes, 1)
        return mean, np.sqrt(np.einsum("i...,ij,j...->...", slopes, self.covariance, slopes))


def prediction(data: Dataset, varied: list[str]) -> Prediction | None:
    """What predicts the samples of a sweep, if every quantity that varies has derivatives, and some case has them."""
    names = [str(name) for name in data["by"].values] if "d_cost" in data else []
    columns = {name: np.asarray(data[name].values, dtype=float) for name in varied if np.ptp(data[name].values) > 0.0}
    own = [name.removesuffix("_") if name not in names else name for name in columns]
    if not columns or not set(own) <= set(names):
        return None
    points = np.column_stack(list(columns.values()))
    known = (statuses(data) == "solved") & np.isfinite(data["d_cost"].values).all(axis=1)
    if not known.any():
        return None
    mean, deviations = points.mean(axis=0), points.std(axis=0)
    distances = (((points - mean) / deviations) ** 2).sum(axis=1)
    centre = int(np.argmin(np.where(known, distances, np.inf)))
    if data.attrs.get("cases") == "table":
        covariance = np.atleast_2d(np.cov(points.T, bias=True))
    else:
        covariance = np.diag(deviations**2)
    return Prediction(centre, [names.index(name) for name in own], mean - points[centre], covariance)
