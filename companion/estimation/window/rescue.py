"""Sweeps that do not agree with the map, aligned with it jointly until they do: a way back for a filter that is lost.

After a gap of the IMU nobody knows attitude and velocity, and each sweep alone, smeared by the wrong velocity, finds
no place; nor does a search from many places. Jointly they do: what moves between them is the IMU's again, so the error
that all have in common stands out, and with it the velocity by which the next one is deskewed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import msgspec
import numpy as np

from companion.core.messages import Array, Array32
from companion.core.rig import Rig
from companion.estimation.course import Course
from companion.estimation.normal import Normal
from companion.estimation.point_map import PointMap
from companion.estimation.registration import PlaneRegistration
from companion.estimation.window.joint_window import JointWindow, JointWindowConfig

if TYPE_CHECKING:  # of the front end, which has a rescue
    from companion.estimation.lio import LioConfig

_MET = 0.05  # of a sweep's points: fewer on the map say nothing


class RescueConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Whether a window looks for the place too, and when what it says is taken."""

    enabled: bool = True  # where sweeps do not agree with the map after a gap; idle else
    window: JointWindowConfig = JointWindowConfig()
    points: Annotated[int, msgspec.Meta(ge=50)] = 1500  # of a sweep, at most: fewer cost less, and take longer
    in_a_row: Annotated[int, msgspec.Meta(ge=1)] = 3  # sweeps of which most must lie on the map


class Rescue:
    """Idle until a first sweep disagrees; then a window runs beside the filter and registers all of them."""

    def __init__(self, lio: LioConfig, rig: Rig) -> None:
        self._lio, self._rig = msgspec.structs.replace(lio, points=min(lio.points, lio.rescue.points)), rig
        self._window: JointWindow | None = None
        self._agreed = 0

    def predict(self, imu: Array, gap_s: float) -> None:
        """The IMU goes on: pieces (N, 7), with a longest time `gap_s` between samples."""
        if self._window is not None:
            self._window.predict(imu, gap_s=gap_s)

    def end(self) -> None:
        """Not needed any more."""
        self._window, self._agreed = None, 0

    def look(
        self, course: Course, target: PointMap, points_sensor: Array32, age_s: Array32
    ) -> tuple[Array32, Normal] | None:
        """Take a sweep (N, 3) that did not agree; None: not found yet.

        Else `course` becomes that of the window, and the sweep, deskewed by it, is returned with what it said.
        """
        if not self._lio.rescue.enabled:
            return None
        try:
            window, body = self._registered(course, target, points_sensor, age_s)
        except np.linalg.LinAlgError:  # what cannot be solved is begun anew with the next sweep
            self.end()
            return None
        self._agreed = self._agreed + 1 if self._agrees(window) else 0
        if self._agreed < self._lio.rescue.in_a_row or window.normal is None or not window.filter.is_sound:
            return None
        course.become(window.course)
        self.end()
        return body, window.normal

    def _registered(
        self, course: Course, target: PointMap, points_sensor: Array32, age_s: Array32
    ) -> tuple[JointWindow, Array32]:
        if self._window is None:
            how = self._lio.rescue.window, self._lio, self._rig
            self._window = JointWindow(course.copy(), target, *how, grows=False)
        return self._window, self._window.add_sweep(points_sensor, age_s)

    def _agrees(self, window: JointWindow) -> bool:
        """Whether most of what the newest sweep meets in the map lies on it; what the window saw does not count."""
        scan = PlaneRegistration(window.map, window.newest_points, self._lio.plane)
        state, c = window.filter.state, self._lio.search
        fitting, met, offered = scan.fits(state.R, state.p, c.fits_m)
        return met > _MET * offered and fitting > c.doubted_share * met
