"""Tests of trust in vehicles: vehicles that agree only with each other, and not with the honest
majority, gain no trust.
"""

from __future__ import annotations

import numpy as np
import pytest

from fleet_service.fusion import Fusion, constants
from fleet_service.fusion.trust import initial_trust
from fleet_service.serve.alerts import Alerts
from tests.fleet_service.examples import belief, observations, slippery, value

HONEST = np.arange(20)
LIARS = np.arange(100, 108)


def drive_liars(private: int = 0, *, enrolled: bool = False) -> Fusion:
    """Return a fusion (beliefs about all cells) after half an hour of reports about four cells.
    Twenty honest vehicles report a friction near 0.8, eight liars 0.25. Each liar also sends
    `private` reports a minute about other cells, which only liars visit.
    """
    rng = np.random.default_rng(4)
    fusion = Fusion(120.0, enrolled=enrolled)
    for minute in range(30):
        who = np.concatenate([rng.choice(HONEST, 12), LIARS, np.repeat(LIARS, private)])
        cells = np.concatenate(
            [rng.integers(0, 4, 12 + len(LIARS)), 100 + rng.integers(0, 4, private * len(LIARS))]
        )
        mu = np.where(who < 100, 0.8 + 0.05 * rng.normal(size=len(who)), 0.25)
        fusion.update(
            observations(60.0 * minute + np.sort(rng.random(len(who))), who, value(mu), cell=cells)
        )
    return fusion


@pytest.mark.parametrize("private", [0, 5])
def test_group_that_agrees_only_with_itself_loses_its_vote(
    private: int,
) -> None:
    fusion = drive_liars(private)
    assert max(fusion.trust(int(v)) for v in LIARS) < 0.1
    assert min(fusion.trust(int(v)) for v in HONEST) > 0.8


def test_a_newcomer_is_believed_less_once_others_are_known() -> None:
    assert initial_trust() == pytest.approx(0.75)
    assert Fusion(120.0).trust(7) == pytest.approx(initial_trust())
    assert drive_liars().trust(999) == pytest.approx(constants.NEWCOMER)


def test_two_new_enrolled_vehicles_raise_an_alert() -> None:
    raised = []
    for enrolled in (False, True):
        fusion = drive_liars(enrolled=enrolled)
        seconds = 1900.0 + 60.0 * np.arange(2)
        updated = fusion.update(
            observations(seconds, np.array([998, 999]), value(np.full(2, 0.15)), cell=50)
        )
        alerts = Alerts(fusion).update(updated.slots)
        raised.append([alert.vehicles for alert in alerts])
    assert raised == [[], [2]]


def test_an_enrolled_vehicle_starts_like_one_that_agreed_with_all_others() -> None:
    most = (1.0 - constants.CONTAMINATION_LEAST) / (1.0 - constants.CONTAMINATION)
    assert Fusion(120.0, enrolled=True).trust(7) == pytest.approx(most)
    assert drive_liars(enrolled=True).trust(999) == pytest.approx(most)


def test_two_enrolled_witnesses_outweigh_two_dry_visits_of_the_last_minute() -> None:
    p_slippery = []
    for enrolled in (False, True):
        fusion = Fusion(120.0, enrolled=enrolled)
        fusion.update(observations(np.arange(2.0), np.arange(2), value(np.full(2, 0.8))))
        fusion.update(observations(20.0 + np.arange(2), 10 + np.arange(2), value(np.full(2, 0.15))))
        p_slippery.append(slippery(belief(fusion)))
    assert p_slippery[0] < 0.9 < p_slippery[1]


def test_enrolled_liars_still_lose_their_vote() -> None:
    fusion = drive_liars(enrolled=True)
    assert max(fusion.trust(int(v)) for v in LIARS) < 0.1
    assert min(fusion.trust(int(v)) for v in HONEST) > 0.8


def test_vehicle_that_agreed_with_enough_known_ones_is_established() -> None:
    """The record of a vehicle's meetings has few places. Meetings with the first few vehicles must
    not displace each other, or the vehicle stays a newcomer and supports no alert.
    """
    fusion = Fusion(120.0)
    for minute in range(10):
        seconds = 60.0 * minute + np.arange(len(HONEST))
        fusion.update(observations(seconds, HONEST, value(np.full(len(HONEST), 0.8))))
    met = int(constants.ESTABLISHED_PEERS)
    new = np.arange(1000, 1100)
    who = np.concatenate([np.tile(HONEST[:met], (len(new), 1)), new[:, None]], axis=1).ravel()
    cells = np.repeat(50 + np.arange(len(new)), met + 1)
    for begin in (600.0, 900.0):  # the second time is later than the next epoch
        fusion.update(
            observations(
                begin + 0.1 * np.arange(len(who)), who, value(np.full(len(who), 0.8)), cell=cells
            )
        )
    assert fusion.trust(999) == pytest.approx(constants.NEWCOMER)
    assert min(fusion.trust(int(v)) for v in new) >= constants.SOURCE_TRUST


def test_any_number_of_newcomers_together_has_less_than_two_votes() -> None:
    fusion = drive_liars()
    n = 200
    updated = fusion.update(
        observations(1900.0 + np.arange(n), 1000 + np.arange(n), value(np.full(n, 0.2)), cell=1)
    )
    assert slippery(belief(fusion, cell=1)) < 0.1
    assert not Alerts(fusion).update(updated.slots)


def test_a_vehicle_that_keeps_changing_its_mind_has_two_votes() -> None:
    fusion = Fusion(120.0)
    fusion.update(observations(np.arange(6) * 10.0, np.arange(6), value(np.full(6, 0.8))))
    n = 60
    flips = np.where(np.arange(n) % 2 == 0, 0.1, 1.1)
    fusion.update(observations(100.0 + np.arange(n), np.full(n, 50), value(flips)))
    assert fusion.live.values[0] < 6 * 0.75 + 0.75 * (constants.VOTES + 0.2)
