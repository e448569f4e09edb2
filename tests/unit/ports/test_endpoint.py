"""MAVLink URLs: what is meant, and a clear word about what is not one."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.core.errors import InputError
from companion.runtime.ports.endpoint import Endpoint, parse_endpoint


@pytest.mark.parametrize(
    "url, endpoint",
    [
        ("udp://127.0.0.1:14540", Endpoint("udpin", "127.0.0.1", 14540)),
        ("udpin://:14540", Endpoint("udpin", "127.0.0.1", 14540)),
        ("udpin://0.0.0.0:14540/", Endpoint("udpin", "0.0.0.0", 14540)),
        ("udpout://drone-1.local:14550", Endpoint("udpout", "drone-1.local", 14550)),
        ("tcp://localhost:5760", Endpoint("tcp", "localhost", 5760)),
        ("tcpin://[::1]:5760", Endpoint("tcpin", "::1", 5760)),
        ("udpout://[fe80::1%eth0]:1", Endpoint("udpout", "fe80::1%eth0", 1)),
        ("serial:///dev/ttyACM0:921600", Endpoint("serial", path="/dev/ttyACM0", baud=921600)),
        (" serial:///dev/serial/by-id/usb-3D_PX4_v6-if00:57600 ",
         Endpoint("serial", path="/dev/serial/by-id/usb-3D_PX4_v6-if00", baud=57600)),
    ],
)  # fmt: skip
def test_what_a_url_means(url, endpoint):
    assert parse_endpoint(url) == endpoint
    assert parse_endpoint(str(endpoint)) == endpoint


def test_plain_udp_is_the_callers_choice():
    assert parse_endpoint("udp://1.2.3.4:5", udp_means="out").kind == "udpout"
    assert parse_endpoint("udpin://1.2.3.4:5", udp_means="out").kind == "udpin"


@pytest.mark.parametrize(
    "url, problem",
    [
        ("", "is no MAVLink URL"),
        ("127.0.0.1:14540", "is no MAVLink URL"),
        ("http://127.0.0.1:80", "has the unknown scheme http://"),
        ("udpin://127.0.0.1", "needs HOST:PORT"),
        ("udpin://127.0.0.1:0", "has port 0, not 1..65535"),
        ("udpin://127.0.0.1:65536", "has port 65536"),
        ("udpin://::1:14540", "needs HOST:PORT"),
        ("udpin://a b:14540", "needs HOST:PORT"),
        ("udpout://:14540", "names no host to send to"),
        ("tcp://:5760", "names no host to send to"),
        ("serial:///dev/ttyACM0", "needs a device and a baud rate"),
        ("serial://ttyACM0:921600", "needs a device and a baud rate"),
        ("serial:///dev/ttyACM0:12", "has baud rate 12"),
    ],
)
def test_what_is_wrong_is_named_with_the_valid_forms(url, problem):
    with pytest.raises(InputError, match="serial:///dev/ttyX:BAUD") as caught:
        parse_endpoint(url, field="--vehicle")
    assert f"--vehicle: {url!r} {problem}" in str(caught.value)


@given(st.text(max_size=60))
def test_any_text_is_an_endpoint_or_an_input_error(text):
    try:
        endpoint = parse_endpoint(text)
    except InputError:
        return
    assert parse_endpoint(str(endpoint)) == endpoint
