"""Photometric alignment of patches: an image's grey levels as normal equations of the pose.

Each patch says how far its picture lies from where the pose puts it: one Gauss-Newton step of the sum of squared
grey differences over its pixels, after gain and offset. Its covariance is that of the grey levels, and what is wrong
with the patch itself: depth, by which it slips along the ray on which it was first seen, and a floor in pixels. So
a patch without slope along an edge says nothing along it, and all of them come to H (6, 6) and g (6,) of the pose.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from companion.estimation.patches import grey_at

NEAREST_M = 0.2
SHARED = 9  # what all patches depend on: the pose (6), and how the ground as a whole is off (3)
OUTSIDE, MISSED, FOUND = 0, 1, 2  # what became of a patch


@njit(cache=True, nogil=True)
def project(centre, R, p, mount, intrinsics, pixel, J, Q):  # type: ignore[no-untyped-def]
    """Point in odom (3,) to `pixel` (2,); J (2, 6): d pixel / d (theta_body, p_odom); Q (2, 3): d pixel / d centre.

    Returns the depth in m; nothing is written where it is below NEAREST_M.
    """
    RBC, pBC = mount
    focal, cx, cy = intrinsics
    b, e = np.empty(3), np.empty(3)
    d0, d1, d2 = centre[0] - p[0], centre[1] - p[1], centre[2] - p[2]
    for i in range(3):
        b[i] = R[0, i] * d0 + R[1, i] * d1 + R[2, i] * d2
    for i in range(3):
        e[i] = RBC[0, i] * (b[0] - pBC[0]) + RBC[1, i] * (b[1] - pBC[1]) + RBC[2, i] * (b[2] - pBC[2])
    if e[2] < NEAREST_M:
        return e[2]
    scale = focal / e[2]
    pixel[0], pixel[1] = scale * e[0] + cx, scale * e[1] + cy
    for a in range(2):
        slope = -scale * e[a] / e[2]
        h0 = RBC[0, a] * scale + RBC[0, 2] * slope  # d pixel / d point in the body frame
        h1 = RBC[1, a] * scale + RBC[1, 2] * slope
        h2 = RBC[2, a] * scale + RBC[2, 2] * slope
        J[a, 0], J[a, 1], J[a, 2] = h1 * b[2] - h2 * b[1], h2 * b[0] - h0 * b[2], h0 * b[1] - h1 * b[0]
        for j in range(3):
            Q[a, j] = h0 * R[j, 0] + h1 * R[j, 1] + h2 * R[j, 2]
            J[a, 3 + j] = -Q[a, j]
    return e[2]


@njit(cache=True, nogil=True)
def compare(image, x, y, A, picture, slopes, sums):  # type: ignore[no-untyped-def]
    """Grey levels of a patch around pixel (x, y) of a level; A (2, 2): its pixels' spacing there.

    `sums` gets their spread, their product with the picture and with its two slopes; False: it leaves the image.
    """
    height, width = image.shape
    n = picture.shape[0]
    side = int(np.sqrt(n) + 0.5)
    half = side // 2
    reach_x, reach_y = half * (abs(A[0, 0]) + abs(A[0, 1])), half * (abs(A[1, 0]) + abs(A[1, 1]))
    if not (x - reach_x > 0 and y - reach_y > 0 and x + reach_x < width - 2 and y + reach_y < height - 2):
        return False
    total, square, along, s0, s1 = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(side):
        dv = i - half
        for k in range(side):
            du = k - half
            j = i * side + k
            grey = grey_at(image, x + A[0, 0] * du + A[0, 1] * dv, y + A[1, 0] * du + A[1, 1] * dv)
            total += grey
            square += grey * grey
            along += picture[j] * grey
            s0 += slopes[j, 0] * grey
            s1 += slopes[j, 1] * grey
    sums[0], sums[1], sums[2], sums[3] = square - total * total / n, along, s0, s1
    return True


@njit(cache=True, nogil=True)
def measure(A, step, inverse, sums, energy, trust, residual, C):  # type: ignore[no-untyped-def]
    """Pixel minus projection (2,) in the full image, and its covariance C (2, 2) from grey levels; False: unlike.

    `step`: pixels of the full image per pixel of the level; `trust`: least sigma of grey, pixels that count as
    one, least correlation, and the number of pixels.
    """
    sigma_grey, correlated, least, n = trust
    spread, along, s0, s1 = sums
    gain = along / energy
    if not along > least * np.sqrt(spread * energy):
        return False
    rest = (spread - gain * along) / (n - 4.0)
    noise = max(rest, sigma_grey * sigma_grey) * correlated / (gain * gain)
    d0 = (inverse[0, 0] * s0 + inverse[0, 1] * s1) / gain
    d1 = (inverse[1, 0] * s0 + inverse[1, 1] * s1) / gain
    for a in range(2):
        residual[a] = -step * (A[a, 0] * d0 + A[a, 1] * d1)
        for c in range(2):
            left0 = A[a, 0] * inverse[0, 0] + A[a, 1] * inverse[1, 0]
            left1 = A[a, 0] * inverse[0, 1] + A[a, 1] * inverse[1, 1]
            C[a, c] = step * step * noise * (left0 * A[c, 0] + left1 * A[c, 1])
    return True


@njit(cache=True, nogil=True)
def add(J, residual, C, cauchy, gate, H, g):  # type: ignore[no-untyped-def]
    """Weigh a residual by its covariance and Cauchy's rule; False if its chi2 is beyond the gate."""
    det = C[0, 0] * C[1, 1] - C[0, 1] * C[1, 0]
    w00, w01, w11 = C[1, 1] / det, -C[0, 1] / det, C[0, 0] / det
    ru, rv = residual[0], residual[1]
    chi2 = w00 * ru * ru + 2.0 * w01 * ru * rv + w11 * rv * rv
    if not chi2 <= gate:
        return False
    root = cauchy / (cauchy + chi2)
    weight = root * root
    for i in range(SHARED):
        left0 = weight * (w00 * J[0, i] + w01 * J[1, i])
        left1 = weight * (w01 * J[0, i] + w11 * J[1, i])
        g[i] += left0 * ru + left1 * rv
        for j in range(SHARED):
            H[i, j] += left0 * J[0, j] + left1 * J[1, j]
    return True


@njit(cache=True, nogil=True)
def look(patches, q, level, view, grey, scratch):  # type: ignore[no-untyped-def]
    """Where patch q lies against where the pose puts it, into `scratch`; OUTSIDE, MISSED or FOUND.

    `scratch`: J (2, 6), Q (2, 3), A and C (2, 2), pixel, residual and slip (2,: pixels per m of depth), sums (4,).
    """
    centres, tangents, rays, pictures, energy, slopes, inverse = patches
    image, R, p, mount, intrinsics = view
    J, Q, A, C, pixel, residual, slip, sums = scratch
    if energy[q, level] <= 0.0 or project(centres[q], R, p, mount, intrinsics, pixel, J, Q) < NEAREST_M:
        return OUTSIDE
    for a in range(2):
        for c in range(2):
            A[a, c] = Q[a, 0] * tangents[q, 0, c] + Q[a, 1] * tangents[q, 1, c] + Q[a, 2] * tangents[q, 2, c]
        slip[a] = Q[a, 0] * rays[q, 0] + Q[a, 1] * rays[q, 1] + Q[a, 2] * rays[q, 2]
    step = 2.0**level
    x, y = pixel[0] / step - 0.5, pixel[1] / step - 0.5
    if not compare(image, x, y, A, pictures[q, level], slopes[q, level], sums):
        return OUTSIDE
    found = measure(A, step, inverse[q, level], sums, energy[q, level], grey, residual, C)
    return FOUND if found else MISSED


@njit(cache=True, nogil=True)
def linearise(patches, level, view, trust, H, g, fate):  # type: ignore[no-untyped-def]
    """Normal equations 0.5 dx' H dx - g' dx of dx = (theta_body, p_odom, ground); returns how many patches were used.

    ground (3,): the height by which the surface is off under the vehicle, m, and its slopes along x and y of odom.

    `patches`: as in `Patches`, without `misses`; `view`: the level's image, R, p, mount, intrinsics; `trust`: of grey
    levels, of depth (variance, m2) and of the pixel (variance, px2), Cauchy's constant, gate; `fate` (N,): of each.
    """
    grey, depth_variance, floor, cauchy, gate = trust
    J, C, residual, slip = np.empty((2, SHARED)), np.empty((2, 2)), np.empty(2), np.empty(2)
    scratch = (J, np.empty((2, 3)), np.empty((2, 2)), C, np.empty(2), residual, slip, np.empty(4))
    H[:], g[:] = 0.0, 0.0
    used = 0
    for q in range(fate.shape[0]):
        fate[q] = look(patches, q, level, view, grey, scratch)
        if fate[q] != FOUND:
            continue
        for a in range(2):
            C[a, a] += floor
            for c in range(2):
                C[a, c] += depth_variance * slip[a] * slip[c]
            J[a, 6] = slip[a] / patches[2][q, 2]  # the ray comes down by as much as the ground is higher
            J[a, 7] = J[a, 6] * (patches[0][q, 0] - view[2][0])
            J[a, 8] = J[a, 6] * (patches[0][q, 1] - view[2][1])
        if add(J, residual, C, cauchy, gate, H, g):
            used += 1
        else:
            fate[q] = MISSED
    return used


@njit(cache=True, nogil=True)
def eliminate(H, g, sigmas):  # type: ignore[no-untyped-def]
    """Takes the last unknowns of H (N, N) and g (N,), known to `sigmas` about zero, out of the others (Schur)."""
    least = H.shape[0] - sigmas.shape[0]
    for k in range(H.shape[0] - 1, least - 1, -1):
        pivot = H[k, k] + 1.0 / (sigmas[k - least] * sigmas[k - least])
        for i in range(k):
            share = H[i, k] / pivot
            g[i] -= share * g[k]
            for j in range(k):
                H[i, j] -= share * H[k, j]
