"""Log-odds steps keep the model's ratios."""

import math

import pytest

from companion.core.errors import InputError
from companion.mapping.sensor_model import SensorModel, log_odds, quantise


def test_steps_keep_octomaps_probabilities():
    steps = quantise(SensorModel(hit=0.7, miss=0.4, lowest=0.12, highest=0.97))
    assert steps.hit / -steps.miss == pytest.approx(log_odds(0.7) / -log_odds(0.4), rel=0.005)
    for step, probability in ((steps.hit, 0.7), (steps.miss, 0.4), (steps.lowest, 0.12), (steps.highest, 0.97)):
        assert step / steps.per_unit == pytest.approx(log_odds(probability), abs=0.03)
    assert -128 < steps.lowest < steps.highest <= 127


def test_by_default_a_branch_stays_that_one_scan_in_seven_sees_and_what_left_is_gone_in_three_seconds():
    steps = quantise(SensorModel())
    assert steps.hit + 7 * steps.miss >= 0  # from the class border: still occupied
    assert steps.lowest + steps.hit >= 0  # one return occupies a voxel that was free
    scans_per_s = 10
    assert steps.highest / -steps.miss <= 3 * scans_per_s


def test_log_odds_is_the_inverse_of_the_logistic():
    assert 1 / (1 + math.exp(-log_odds(0.83))) == pytest.approx(0.83)


def test_probabilities_out_of_order_are_refused():
    with pytest.raises(InputError, match="lowest < miss"):
        SensorModel(hit=0.4, miss=0.6)


def test_steps_too_small_for_int8_are_refused():
    with pytest.raises(InputError, match="too weak"):
        quantise(SensorModel(hit=0.5001, miss=0.4999))
