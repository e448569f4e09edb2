"""rosidl's own type descriptions as the oracle of `described_library`; needs ROS 2 (AMENT_PREFIX_PATH)."""

import json
import os
from pathlib import Path

import pytest

from companion.runtime.wire.described import described_library
from companion.runtime.wire.types import ServiceType, Types

SHARE = Path(os.environ.get("AMENT_PREFIX_PATH", "/nowhere").split(":")[0]) / "share"
FILES = sorted([*SHARE.glob("*/msg/*.json"), *SHARE.glob("*/srv/*.json")])
pytestmark = pytest.mark.skipif(not FILES, reason="no ROS 2 is installed")


@pytest.mark.parametrize("file", FILES, ids=lambda f: f"{f.parts[-3]}-{f.stem}")
def test_a_described_type_has_the_hash_that_rosidl_gave_it(file):
    told = json.loads(file.read_text())
    name = told["type_description_msg"]["type_description"]["type_name"]
    hashes = {h["type_name"]: h["hash_string"] for h in told["type_hashes"]}
    types = Types(described_library(told["type_description_msg"], expect_hash=hashes[name]))
    assert types[name].type_hash == hashes[name]
    for other, text in hashes.items():
        assert types[other].type_hash == text
        value = types[other].default()
        assert types[other].encode(types[other].decode(types[other].encode(value))) == types[other].encode(value)
    if "/srv/" in name:
        assert ServiceType(name, types).type_hash == hashes[name]
