"""Parameters: bytewise encoding, list, read, set; and their effect."""

import struct

import pytest
from pymavlink.dialects.v20 import all as dialect

from companion.core.errors import InputError
from sim.autopilot.codec import Encoder, Parser
from sim.autopilot.params import DEFAULTS, Parameters, ParameterService


def talk(service, message):
    mav = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    return [f.named for f in Parser().feed(service.handle(Parser().feed(message.pack(mav))[0]))]


def drain(service):
    found, parser = [], Parser()
    while data := service.due():
        found += [f.named for f in parser.feed(data)]
    return found


@pytest.fixture
def parameters():
    return Parameters()


@pytest.fixture
def service(parameters):
    return ParameterService(parameters, Encoder(system=1, component=1))


def text(raw):
    return raw.rstrip(b"\0").decode()


def decoded(answer):
    value = answer["param_value"]
    return struct.unpack("<i", struct.pack("<f", value))[0] if answer["param_type"] == 6 else value


def test_the_list_is_complete_and_decodes_bytewise(service):
    talk(service, dialect.MAVLink_param_request_list_message(1, 1))
    answers = drain(service)
    assert [text(a["param_id"]) for a in answers] == sorted(DEFAULTS)
    assert [a["param_index"] for a in answers] == list(range(len(DEFAULTS)))
    for answer in answers:
        assert answer["param_count"] == len(DEFAULTS)
        assert decoded(answer) == pytest.approx(DEFAULTS[text(answer["param_id"])], rel=1e-6)
    assert drain(service) == []


def test_read_by_name_and_by_index(service):
    by_name = talk(service, dialect.MAVLink_param_request_read_message(1, 1, b"EKF2_EV_CTRL", -1))
    assert decoded(by_name[0]) == 15
    again = talk(service, dialect.MAVLink_param_request_read_message(1, 1, b"", by_name[0]["param_index"]))
    assert again == by_name
    assert talk(service, dialect.MAVLink_param_request_read_message(1, 1, b"NO_SUCH", -1)) == []
    assert talk(service, dialect.MAVLink_param_request_read_message(1, 1, b"", 9999)) == []


@pytest.mark.parametrize(("name", "value"), [("COM_OBL_RC_ACT", 4), ("MPC_XY_P", 0.8), ("EKF2_NOAID_TOUT", 3_000_000)])
def test_set_and_read_back(service, parameters, name, value):
    integer = isinstance(value, int)
    wire = struct.unpack("<f", struct.pack("<i", value))[0] if integer else value
    version = parameters.version
    answer = talk(service, dialect.MAVLink_param_set_message(1, 1, name.encode(), wire, 6 if integer else 9))[0]
    assert decoded(answer) == pytest.approx(value)
    assert parameters[name] == pytest.approx(value)
    assert parameters.version == version + 1


def test_a_set_with_the_wrong_type_or_no_number_changes_nothing(service, parameters):
    for value, kind in ((3.0, 6), (float("nan"), 9)):
        talk(service, dialect.MAVLink_param_set_message(1, 1, b"MPC_XY_P", value, kind))
        assert parameters["MPC_XY_P"] == DEFAULTS["MPC_XY_P"]


def test_a_misspelt_override_is_named_with_its_neighbours():
    with pytest.raises(InputError, match=r"MPC_XY_PP.*MPC_XY_P"):
        Parameters({"MPC_XY_PP": 1.0})


def test_over_the_link_foreign_targets_are_ignored(bench):
    b = bench()
    b.send(dialect.MAVLink_param_request_list_message(9, 1))
    b.run(0.3)
    assert b.of("PARAM_VALUE") == []
    b.send(dialect.MAVLink_param_request_list_message(1, 1))
    b.run(0.3)
    assert len({m.param_id for m in b.of("PARAM_VALUE")}) == len(DEFAULTS)
