"""Every topic's message to CDR and back."""

from __future__ import annotations

from typing import Any

from companion.core import messages as m
from companion.core.errors import InputError
from companion.core.node import Topic
from companion.runtime.wire import cloud, own, standard, voxel_cloud
from companion.runtime.wire.cdr_read import MALFORMED
from companion.runtime.wire.errors import WireError
from companion.runtime.wire.own import FromValue, ToValue
from companion.runtime.wire.types import Payload, WireType, wire_type

_STANDARD: dict[tuple[type[Any], str], tuple[ToValue, FromValue]] = {
    (m.ImuSample, "sensor_msgs/msg/Imu"): (standard.imu_value, standard.imu_sample),
    (m.LidarScan, "sensor_msgs/msg/PointCloud2"): (cloud.cloud_of, cloud.scan_of),
    (m.OccupiedVoxels, "sensor_msgs/msg/PointCloud2"): (voxel_cloud.cloud_of, voxel_cloud.voxels_of),
    (m.CameraImage, "sensor_msgs/msg/Image"): (standard.image_value, standard.camera_image),
    (m.RangeReading, "sensor_msgs/msg/Range"): (standard.range_value, standard.range_reading),
    (m.BaroReading, "sensor_msgs/msg/FluidPressure"): (standard.pressure_value, standard.baro_reading),
}


class Codec:
    """One message class over one ROS 2 type."""

    def __init__(self, kind: WireType, to_value: ToValue, from_value: FromValue) -> None:
        self.type = kind
        self._to_value, self._from_value = to_value, from_value

    def encode(self, message: Any) -> bytes:
        """CDR of a message; InputError if a number does not fit (a stamp beyond 2038)."""
        return self.type.encode(self._to_value(message))

    def decode(self, payload: Payload) -> Any:
        """The message, its arrays read-only; WireError if the payload is none."""
        value = self.type.decode(payload)
        try:
            return self._from_value(value)
        except WireError as error:
            raise WireError(f"{self.type.name}: {error}") from None
        except MALFORMED as error:
            raise WireError(f"{self.type.name}: {error}") from None


def codec_of(topic: Topic[Any]) -> Codec:
    """The codec of a topic's message class over its `ros_type`."""
    key: tuple[Any, str] = (topic.type, topic.ros_type)
    if key not in _made:
        _made[key] = _make(*key)
    return _made[key]


def _make(kind: Any, ros_type: str) -> Codec:
    wire = wire_type(ros_type)
    if (kind, ros_type) in _STANDARD:
        return Codec(wire, *_STANDARD[kind, ros_type])
    if not ros_type.startswith(f"{own.PACKAGE}/"):
        carried = ", ".join(f"{k.__name__} as {name}" for k, name in _STANDARD)
        raise InputError(f"nothing carries {kind.__name__} as {ros_type}", field="ros_type", valid=carried)
    return Codec(wire, *own.converters(kind, wire, wire_type))


_made: dict[tuple[Any, str], Codec] = {}
