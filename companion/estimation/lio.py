"""LiDAR-inertial odometry with an optional camera: the front end, without messages.

lio = Lio.at_rest(imu_samples, LioConfig(), rig)
lio.predict(imu_pieces)                   # (N, 7): dt, rate, specific force
lio.update_lidar(points_sensor, age_s)    # returns what the scan said
lio.filter.state.p                        # where we are, in odom
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
import numpy as np

from companion.core.messages import Array, Array32, Bytes2D
from companion.core.rig import Rig
from companion.estimation.blind_axes import BlindAxes, BlindAxesConfig, BlindDrift
from companion.estimation.camera import CameraConfig, CameraTracker
from companion.estimation.clock_doubt import ClockDoubt
from companion.estimation.course import Course
from companion.estimation.deskew import ScanGate
from companion.estimation.direct_camera import DirectCamera
from companion.estimation.downsample import Thinner
from companion.estimation.features import EdgeMap, EdgesAndPlanes, EdgesConfig, Registration
from companion.estimation.filter import Filter, Linearise
from companion.estimation.fit_watch import FitWatch
from companion.estimation.imu_doubt import ImuDoubt, ImuDoubtConfig
from companion.estimation.lines import LineConfig, LineRegistration
from companion.estimation.map_error import MapError, MapErrorConfig
from companion.estimation.normal import Normal
from companion.estimation.point_map import PointMap, PointMapConfig
from companion.estimation.propagation import ImuNoise
from companion.estimation.registration import PlaneConfig, PlaneRegistration
from companion.estimation.scan_result import ScanResult
from companion.estimation.search import SearchConfig, few_of, search
from companion.estimation.standing import Standing, StandingConfig
from companion.estimation.start import StartConfig, start_filter
from companion.estimation.window.rescue import Rescue, RescueConfig

Count = Annotated[int, msgspec.Meta(ge=1)]
_MET = 0.05  # of a sweep's points: fewer on the map say nothing
_SURELY = 0.4  # of a sweep's points on the map: it tells which course is right


class LioConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The front end."""

    noise: ImuNoise = ImuNoise()
    start: StartConfig = StartConfig()
    standing: StandingConfig = StandingConfig()
    gate: ScanGate = ScanGate()
    map: PointMapConfig = PointMapConfig(averaged=20)
    plane: PlaneConfig = PlaneConfig(flatness_m=0.03, sigma_m=0.03)
    features: Literal["planes", "edges_and_planes"] = "planes"  # the second for thin poles, which have no planes
    edges: EdgesConfig = EdgesConfig()
    map_error: MapErrorConfig = MapErrorConfig()
    search: SearchConfig = SearchConfig()
    rescue: RescueConfig = RescueConfig()
    imu_doubt: ImuDoubtConfig = ImuDoubtConfig()
    weak_below: Annotated[float, msgspec.Meta(ge=0)] = 0.005  # normalised eigenvalue: such an axis is named
    blind: BlindAxesConfig = BlindAxesConfig()
    camera_out_s: Annotated[float, msgspec.Meta(gt=0)] = 0.3  # without an image that was of use
    lidar_out_s: Annotated[float, msgspec.Meta(gt=0)] = 0.25  # without a sweep: camera anchors drift
    thin_m: Annotated[float, msgspec.Meta(gt=0)] = 0.5  # one point per voxel of this edge is registered
    points: Count = 1500  # and at most so many
    iterations: Count = 5
    min_planes: Annotated[int, msgspec.Meta(ge=6)] = 20  # or edges on lines; fewer: the scan is not used


class Lio:
    """Filter, map, and the log of nodes that deskewing needs."""

    def __init__(self, start: Filter, config: LioConfig, rig: Rig, camera: CameraConfig | None = None) -> None:
        self.filter, self.config = start, config
        self._course = Course(start)
        self.map = PointMap(config.map)
        self._map_error, self._track_error = MapError(), MapError()
        self._scan_s = self._looked_s = start.t_s  # when the last sweep was used, and came
        self._back_s: float | None = None  # when sweeps came back after a gap
        self._imu_doubt, self._clock = ImuDoubt(config.imu_doubt), ClockDoubt()
        self._watch, self._silent = FitWatch(), False  # silent: the IMU, during the newest sweep or image
        self._blind, self._drift = BlindAxes(config.blind), BlindDrift(config.blind)
        self._image_s = -np.inf  # when the last image was of use
        self._mount = (rig.lidar.R_body_sensor, rig.lidar.p_body)
        self._thinner = Thinner()
        self._edges = EdgeMap(config.edges, rig.lidar) if config.features == "edges_and_planes" else None
        self._densities = config.noise.densities
        self._standing = Standing(start, config.standing, self._densities)
        self._swept: Normal | None = None  # what the newest sweep said
        self._rescue = Rescue(config, rig)
        self._tracker = self._camera_of(camera or CameraConfig(), rig)

    @classmethod
    def at_rest(cls, samples: Array, config: LioConfig, rig: Rig, camera: CameraConfig | None = None) -> Lio:
        """Start from rate and specific force of a vehicle that stands still, (N, 6)."""
        return cls(start_filter(samples, config.start, t_s=0.0), config, rig, camera)

    def predict(self, imu: Array, *, gap_s: float = 0.0, otherwise: Array | None = None) -> None:
        """Advance through IMU pieces (N, 7): dt, rate, specific force; `gap_s`: the longest time without a sample.

        `otherwise`: the pieces, if what looks like silence is a clock that was set; None: it does not look like that.
        """
        self._clock.predict(imu, self._densities)
        if otherwise is not None:
            self._clock.arise(self._course, otherwise, self._densities)
        if len(imu):
            self._course.predict(imu, self._densities)
            self._rescue.predict(imu, gap_s)
            self._standing.watch(imu, self.filter)
            self._imu_doubt.gap(self.filter, gap_s)
            self._silent = gap_s > self.config.imu_doubt.gap_s
            self._watch.doubts |= self._silent

    def update_lidar(self, points_sensor: Array32, age_s: Array32) -> ScanResult:
        """Take a sweep (N, 3) that ends now; `age_s` (N,) is now minus each point's time."""
        sweep = points_sensor, age_s, self._mount, self.config.gate
        self._clock.settle(self._course, lambda c: self._fits(c, c.deskewed(*sweep)), at_least=_SURELY)
        points_body = self._course.deskewed(*sweep)
        edges_body = self._edges.find(points_body) if self._edges else np.empty((0, 3))
        normal = self._register(points_body, edges_body) if self.map.voxels else None
        if normal is None and self.map.voxels:
            found = self._rescued(points_sensor, age_s)
            if found is None:
                return ScanResult(points_body, None, agrees=False)
            points_body, normal = found
            edges_body = self._edges.find(points_body) if self._edges else edges_body
        self._rescue.end()
        spaced = self._thinner.firsts(points_body, self.config.map.spacing_m)
        if normal is None or normal.used >= self.config.min_planes or not self._is_known(normal):
            if not self._silent:  # nobody knows how the vehicle turned meanwhile, so the sweep is smeared
                self._extend(spaced, edges_body, normal)
            self._scan_s, self._back_s = self.filter.t_s, None
            if normal is not None:
                self._watch.took(normal)
        return ScanResult(points_body, normal)

    @property
    def covariance(self) -> Array:
        """Of the error state in odom, (18, 18): the filter's, and that of the map it measures against."""
        state = self.filter.state
        maps = self._map_error.covariance(state) + self._track_error.covariance(state)
        return self.filter.P + maps + self._drift.covariance

    @property
    def objection(self) -> str:
        """What is wrong with camera and IMU; "": nothing."""
        return "; ".join(o for o in (self._tracker.objection, self._imu_doubt.reason(self.filter.t_s)) if o)

    def turn_directions(self, dirs_sensor: Array32, age_s: Array32) -> Array32:
        """Directions (N, 3) of a sweep that ends now -> the body frame of now."""
        return self._course.directions(dirs_sensor, age_s, self._mount[0])

    def update_camera(self, pixels: Bytes2D) -> Normal | None:
        """Take an image exposed now, (H, W); None if no point could be tracked into it, or nobody knows the time."""
        if self._clock.is_open:
            return None
        before = self._course.pose()
        normal = self._tracker.update(pixels, self.filter, self.map, self.config.plane)
        self._course.moved(before)
        self._image_s = self._image_s if normal is None else self.filter.t_s
        self._drift_of_anchors()
        return normal

    def _drift_of_anchors(self) -> None:
        """While sweeps are out, or blind along the way: then they still hold tilt and height over the ground."""
        out, state = self.filter.t_s - self._scan_s > self.config.lidar_out_s, self.filter.state
        if out or self._blind.shift is not None:
            self._track_error.move(state.p, self._tracker.above_m(state) if out else np.inf)
            share = self._tracker.renewed * self.config.map_error.track_share
            self._track_error.extend(state, self.filter.P, share, tilts=out)

    def _camera_of(self, config: CameraConfig, rig: Rig) -> CameraTracker | DirectCamera:
        return DirectCamera(config, rig, self._hold) if config.method == "direct" else CameraTracker(config, rig)

    def _hold(self) -> float:
        """How well the newest sweep holds its blindest axis (`Normal.weakest`); 0 while sweeps are out."""
        out = self.filter.t_s - self._scan_s > self.config.lidar_out_s
        return 0.0 if out or self._swept is None else self._swept.weakest

    def _register(self, points_body: Array32, edges_body: Array) -> Normal | None:
        """What the sweep said; None: it came after a gap, does not fit the map, and corrected nothing."""
        self._take_back_drift()
        before, prior = self._course.pose(), (self.filter.state.copy(), self.filter.P)
        few = self._thinner.centroids(points_body, self.config.thin_m, at_most=self.config.points)
        c = self.config
        scan = self._registration(few, edges_body, (c.plane, c.edges.line))
        found = self._found(few, edges_body)
        normal = self.filter.update(self._softened(scan), iterations=c.iterations, at_least=c.min_planes, begin=found)
        self._watch.doubts |= self._watch.falls(normal) and self._contradicts(scan)
        if self._is_back() and not self._agrees(scan, prior[1]):
            self.filter.state.x[:], self.filter.P = prior[0].x, prior[1]
            return None
        self._course.moved(before)
        self._standing.seen(normal)
        self._swept = normal
        self._blind.seen()
        self._imu_doubt.corrected(self.filter)
        return normal

    def _rescued(self, points_sensor: Array32, age_s: Array32) -> tuple[Array32, Normal] | None:
        """The sweep, and what it said, if several together agree with the map; while the time is in doubt none does."""
        if self._clock.is_open:
            return None
        found = self._rescue.look(self._course, self.map, points_sensor, age_s)
        self._swept = self._swept if found is None else found[1]
        return found

    def _registration(self, few: Array, edges_body: Array, how: tuple[PlaneConfig, LineConfig]) -> Registration:
        """Of points (N, 3) and edges (M, 3), m, body frame."""
        planes = PlaneRegistration(self.map, few, how[0])
        if self._edges is None:
            return planes
        return EdgesAndPlanes(planes, LineRegistration(self._edges.map, edges_body, how[1]))

    def _softened(self, scan: Registration) -> Linearise:
        """What the scan says, less of it along axes in which it is blind."""
        P = (self.filter.P + self._drift.covariance)[:6, :6]
        return lambda R, p: self._blind.soften(scan.linearise(R, p), P)

    def _found(self, points_body: Array, edges_body: Array) -> tuple[Array, Array] | None:
        """After a gap, where registration is to begin; None: where the filter is."""
        if not self._is_back():
            return None
        return self._looked_for(self.filter, points_body, edges_body)[:2]

    def _fits(self, course: Course, points_body: Array32) -> float:
        """Share of a sweep's points that lie on the map, where they do best about the pose of a course."""
        edges_body = self._edges.find(points_body) if self._edges else np.empty((0, 3))
        thin = self._thinner.centroids(points_body, self.config.thin_m, at_most=self.config.points)
        return self._looked_for(course.filter, thin, edges_body)[2]

    def _looked_for(self, about: Filter, points_body: Array, edges_body: Array) -> tuple[Array, Array, float]:
        P, c = about.P, self.config.search
        few, edges = few_of(points_body, c), few_of(edges_body, c)
        pose, sigma_m = (about.state.R.copy(), about.state.p.copy()), float(np.sqrt(max(P[3, 3], P[4, 4])))
        how = c.plane, c.line
        return search(lambda: self._registration(few, edges, how), pose, sigma_m=sigma_m, config=c)

    def _is_back(self) -> bool:
        """Whether sweeps came back after a gap, or clock, IMU or fit are in doubt, and none has been used since."""
        late = self.filter.t_s - self._scan_s > self.config.search.after_s
        return late or self._clock.is_open or self._watch.doubts

    def _agrees(self, scan: Registration, P: Array) -> bool:
        """Most of what meets the map must lie on it; after a while without, the map goes on from here.

        It goes on with the error that the vehicle may have by then, covariance P: no sweep ever mends that.
        """
        state, c = self.filter.state, self.config.search
        self._back_s = self.filter.t_s if self._back_s is None else self._back_s
        if self.filter.t_s - self._back_s > c.hold_s and not self._clock.is_open:
            self._map_error.extend(state, P, 1.0)
            return True
        fitting, met, offered = scan.fits(state.R, state.p, c.fits_m)
        doubted = self._clock.is_open or self._watch.doubts
        return met > _MET * offered and fitting > (c.doubted_share if doubted else c.agree_share) * met

    def _contradicts(self, scan: Registration) -> bool:
        """Enough meets the map, and most of that lies beside it."""
        fitting, met, offered = scan.fits(self.filter.state.R, self.filter.state.p, self.config.search.fits_m)
        return bool(met > _MET * offered and fitting <= self.config.search.agree_share * met)

    def _take_back_drift(self) -> None:
        """What camera or IMU alone may have drifted, a sweep that sees can mend: it is the filter's then."""
        shift, dt_s = self._blind.shift, self.filter.t_s - self._looked_s
        self._looked_s = self.filter.t_s
        if shift is None:
            self.filter.P = self.filter.P + self._track_error.covariance(self.filter.state)
            self._track_error.reset()
        if shift is not None and self._standing.is_over and self.filter.t_s - self._image_s > self.config.camera_out_s:
            self._drift.grow(shift, dt_s)
        elif self._drift.C.any():
            self.filter.P = self.filter.P + self._drift.covariance
            self._drift.reset()

    def _extend(self, spaced: Array32, edges_body: Array, normal: Normal | None) -> None:
        state = self.filter.state
        seen = (spaced, edges_body, state.R.copy(), state.p.copy())
        settled = self._standing.settled(self.filter.t_s, seen) if self.map.voxels else seen
        if settled is None:
            return
        spaced, edges_body, R, p = settled
        if self._edges is not None:
            self._edges.insert(edges_body, R, p)
        voxels = self.map.voxels
        share = self.map.insert(spaced, R, p) / max(len(spaced), 1)
        self._map_error.move(state.p)
        self._map_error.extend(state, self.filter.P, share * self.config.map_error.share)
        if self._standing.is_over and normal is not None and normal.used >= self.config.min_planes:
            met = len(self._thinner.firsts(spaced, self.config.map.voxel_m))
            self._map_error.lean(normal, (self.map.voxels - voxels) / max(met, 1), self.config.map_error.lean)

    def _is_known(self, normal: Normal) -> bool:
        """Whether the map should have explained the scan; a nearly empty one cannot."""
        return normal.offered > 0 and self.map.voxels > 4 * normal.offered
