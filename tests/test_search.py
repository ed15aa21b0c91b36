"""What a search for causes does where gain and damping alone seem shaken, or noise is what makes a cause likely."""

from __future__ import annotations

import pytest

from servolens import Plant, diagnose, lab
from servolens.diagnosis.ordering import with_twins
from servolens.effects import ActuatorLag, CoulombFriction, SensorLag


def causes_of(campaign):
    found = diagnose(campaign.records, heldout=campaign.heldout)
    return found.verdict, {cause.effect for cause in found.causes}


def test_friction_that_is_likelier_for_the_noise_beside_it_alone_is_no_cause():
    campaign = lab.hidden_campaign(941872, foreign="random_drift")
    verdict, causes = causes_of(campaign)
    assert verdict != "explained"
    assert not causes


def test_rounding_of_a_coarse_encoder_is_no_friction():
    campaign = lab.hidden_campaign(930078, world="coarse")
    assert causes_of(campaign) == ("healthy", set())


def test_second_search_of_a_shaken_axis_begins_with_the_pairs_of_the_first():
    campaign = lab.hidden_campaign(711280, effects=["coulomb_friction", "return_spring"], world="shaken")
    assert causes_of(campaign) == ("explained", {"coulomb_friction", "return_spring"})


@pytest.mark.slow
def test_search_as_if_nothing_shook_the_axis_leaves_effort_for_the_second():
    campaign = lab.hidden_campaign(702281, effects=["saturation"], world="shaken")
    assert causes_of(campaign) == ("explained", {"saturation"})


@pytest.mark.slow
def test_shaken_axis_is_not_taken_for_an_unshaken_one_again_and_again():
    campaign = lab.hidden_campaign(712380, effects=["presliding", "gain_drift"], world="shaken")
    assert causes_of(campaign) == ("explained", {"presliding", "gain_drift"})


@pytest.mark.parametrize(
    ("effect", "other"),
    [
        (ActuatorLag(time_constant=0.004), SensorLag(time_constant=0.004)),
        (SensorLag(time_constant=0.004), ActuatorLag(time_constant=0.004)),
    ],
    ids=["actuator", "sensor"],
)
def test_lag_is_tried_elsewhere_in_the_loop(effect, other):
    plant = Plant(gain=2.0, damping=5.0, effects=(effect, CoulombFriction(level=0.3)))
    (twin,) = with_twins(plant)
    assert set(twin.effects) == {other, CoulombFriction(level=0.3)}
    assert (twin.gain, twin.damping) == (2.0, 5.0)


def test_two_lags_are_not_exchanged():
    lags = (ActuatorLag(time_constant=0.004), SensorLag(time_constant=0.002))
    assert not list(with_twins(Plant(gain=2.0, damping=5.0, effects=lags)))
