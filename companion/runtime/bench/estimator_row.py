"""One line of `companion bench estimators`."""

from __future__ import annotations

import msgspec


class EstimatorRow(msgspec.Struct, frozen=True, kw_only=True):
    """What one estimator did in one case; a figure's name says its unit."""

    study: str
    case: str
    estimator: str
    figures: dict[str, float | None]  # None: there is none, such as the time of what never came
