"""What the direct camera can be told."""

from __future__ import annotations

from typing import Annotated

import msgspec

Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]


class DirectConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Patches, their alignment, and the trust in it."""

    patches: Count = 80  # at most
    refill_below: Count = 50  # look for new ones when fewer are left
    min_patches: Annotated[int, msgspec.Meta(ge=4)] = 8
    min_share: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.3  # of the patches that must be found: some fit by chance
    half_px: Annotated[int, msgspec.Meta(ge=2, le=10)] = 4  # a patch has (2 half_px + 1)^2 pixels
    levels: Annotated[int, msgspec.Meta(ge=1, le=5)] = 3  # of the pyramid, each half as large as the one before
    smooth_px: Positive = 0.8  # sigma of what is smoothed before
    spacing_px: Count = 16  # between the centres of patches
    corner_quality: Positive = 0.02  # smallest eigenvalue of a patch's slopes against the best of the image
    sigma_grey: Positive = 2.0  # at least, of a smoothed grey level
    correlated_px: Positive = 4.0  # pixels that count as one: smoothing and interpolation correlate them
    sigma_depth_m: NotNegative = 0.02  # of a patch along the ray on which it was first seen
    sigma_height_m: Positive = 0.01  # of the surface as a whole
    sigma_slope: Positive = 0.002  # of the surface as a whole, against the vehicle's attitude
    sigma_px: Positive = 0.1  # of a patch, whatever its grey levels say
    min_correlation: Annotated[float, msgspec.Meta(gt=0, lt=1)] = 0.7  # with its picture: less is another thing
    misses: Count = 3  # images in a row without it, and a patch goes
    cauchy: Positive = 9.0
    first_gate: Positive = 400.0  # chi2 of the first iteration
    gate: Positive = 100.0  # of the others
    inflation: Positive = 4.0  # patches are not independent: information is divided by it
    yield_above: Positive = 0.01  # smallest eigenvalue of a sweep (scaled) at which it is divided by two more
    iterations: Count = 4  # at the finest level; one at each of the others
    keep_images: Count = 15  # bad images that the patches outlive
