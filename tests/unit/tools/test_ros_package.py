"""The ROS 2 package that `companion topic package` writes: complete, and naming all that it needs."""

import re
import xml.etree.ElementTree as ET

import pytest

from companion.core.errors import InputError
from companion.runtime.tools.ros_package import write_package
from companion.runtime.wire.idl import parse_msg
from companion.runtime.wire.library import Library


def test_package_holds_every_message_and_declares_what_they_use(tmp_path):
    names = write_package(tmp_path)
    root = tmp_path / "understory_msgs"
    written = {p.stem: parse_msg(f"understory_msgs/msg/{p.stem}", p.read_text()) for p in (root / "msg").iterdir()}
    assert sorted(written) == names
    for name, struct in written.items():
        assert struct.fields == Library().struct(f"understory_msgs/msg/{name}").fields
    used = {f.type.base.split("/")[0] for s in written.values() for f in s.fields if f.type.nested}
    declared = {e.text for e in ET.parse(root / "package.xml").getroot().iter("depend")}
    assert declared == used - {"understory_msgs"}
    cmake = (root / "CMakeLists.txt").read_text()
    assert re.findall(r'"msg/(\w+)\.msg"', cmake) == names
    assert set(re.search(r"DEPENDENCIES (.*)", cmake).group(1).split()) == declared


def test_an_existing_package_is_not_overwritten(tmp_path):
    write_package(tmp_path)
    with pytest.raises(InputError, match="there already"):
        write_package(tmp_path)
