"""Vehicles are known: their bias, their spread, and the slope of their fleet."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from fleet_service.fusion import Fusion, shared
from fleet_service.fusion import constants as c
from fleet_service.fusion.reported import as_reported
from fleet_service.fusion.standing import BIAS_STDS, SPREADS, classes, unknown
from fleet_service.fusion.store.records import ICE
from fleet_service.fusion.trust import slope_std
from schemas import mugrid
from tests.fleet_service.examples import belief, interval, observations, value

VEHICLES = 30


def acquainted(slope: float = 0.0, scatter: float = 0.06, stated: float = 0.06) -> tuple[Fusion, np.ndarray]:
    """A fleet with biases after forty minutes in twenty cells; a value is too low by `slope` for each μ left."""
    rng, fusion = np.random.default_rng(5), Fusion(120.0)
    bias = 0.06 * rng.normal(size=VEHICLES)
    for minute in range(40):
        n = 60
        who, cell, share = rng.integers(0, VEHICLES, n), rng.integers(0, 20, n), rng.uniform(0.5, 1.0, n)
        mu = 0.5 + 0.02 * cell
        reading = mu * (1.0 + bias[who] - slope * (1.0 - share)) + scatter * rng.normal(size=n)
        o = observations(60.0 * minute + np.sort(rng.uniform(0, 60, n)), who, value(reading, stated), cell=cell)
        fusion.update(dataclasses.replace(o, used=(share * mu).astype(np.float32), manoeuvre=np.zeros(n, np.int8)))
    return fusion, bias


def known(fusion: Fusion, name: str) -> np.ndarray:
    return np.array([fusion.error(v)[name] for v in range(VEHICLES)])


def test_biases_are_found_and_nobody_knows_those_of_a_newcomer() -> None:
    fusion, bias = acquainted()
    assert np.corrcoef(known(fusion, "bias"), bias)[0, 1] > 0.75
    assert np.std(known(fusion, "bias") - bias) < 0.75 * np.std(bias)
    assert known(fusion, "bias_std").max() < c.BIAS_RELATIVE
    assert fusion.error(999)["bias"] == 0.0
    assert fusion.error(999)["bias_std"] == pytest.approx(c.BIAS_RELATIVE)


def test_who_tells_its_tyres_is_known_by_them_before_anybody_met_it() -> None:
    """Half of the fleet on winter tyres, which read a tenth less, told and not: a newcomer's error in a cell alone."""
    biases = {}
    for told in (False, True):
        rng, fusion = np.random.default_rng(6), Fusion(120.0)
        winter = np.arange(VEHICLES) % 2
        bias = 0.03 * rng.normal(size=VEHICLES) - 0.1 * winter
        tyre = (1 + winter if told else 0 * winter).astype(np.int8)
        for minute in range(40):
            n = 60
            who, cell = rng.integers(0, VEHICLES, n), rng.integers(0, 20, n)
            reading = (0.5 + 0.02 * cell) * (1.0 + bias[who]) + 0.04 * rng.normal(size=n)
            o = observations(60.0 * minute + np.sort(rng.uniform(0, 60, n)), who, value(reading, 0.04), cell=cell)
            fusion.update(dataclasses.replace(o, tyre=tyre[who], reported=as_reported(o.evidence).reported))
        biases[told] = fusion.standings[-1].errors(np.full(3, 999), np.arange(3))[:, 0]
    assert biases[False].tolist() == [0.0, 0.0, 0.0]
    unknown_kind, summer, of_winter = biases[True]
    assert unknown_kind == 0.0
    assert 0.07 < summer - of_winter < 0.11
    assert of_winter < 0.0 < summer  # which of them is right nobody can see


@pytest.mark.parametrize("slope", [0.0, 0.5])
def test_more_than_half_of_the_slope_of_a_fleet_is_found_and_none_where_there_is_none(slope: float) -> None:
    fusion, _ = acquainted(slope, 0.04, 0.04)
    assert 0.5 * slope <= known(fusion, "slope").mean() <= slope + 0.1
    assert fusion.error(999)["slope"] == pytest.approx(known(fusion, "slope")[0])


def test_who_is_surer_than_right_is_found_and_who_states_what_all_share() -> None:
    right, narrow, wide = (known(acquainted(stated=s)[0], "spread").mean() for s in (0.06, 0.025, 0.12))
    assert right == pytest.approx(1.0, abs=0.2)
    assert narrow > 1.25
    assert wide < 0.8


def test_a_vehicle_with_a_record_sharpens_a_cell_at_its_first_visit_and_a_newcomer_does_not() -> None:
    widths = []
    for who in (3, 999):
        fusion, _ = acquainted()
        fusion.update(observations([2500.0], [who], value([0.6], 0.04), cell=77))
        lower, upper = interval(belief(fusion, cell=77))
        widths.append(upper - lower)
    assert widths[0] < 0.35 < 0.6 < widths[1]


def test_errors_become_classes_that_are_not_less_than_they_are() -> None:
    error = unknown(3)
    error[:, 0], error[:, 1], error[:, 2], error[:, 3] = (-0.05, 0.0, 0.9), (0.03, 0.035, 0.2), (0.5, 1.6, 9.0), 0.0
    found = classes(error)
    assert found[:, 0].tolist() == [-20, 0, 60]
    assert [BIAS_STDS[k] for k in found[:, 1]] == [0.03, 0.04, 0.1]
    assert [SPREADS[k] for k in found[:, 2]] == [1.0, 1.6, 3.2]


def test_a_slope_moves_a_gentle_value_up_and_a_hard_one_not() -> None:
    fusion, _ = acquainted(0.5)
    medians = []
    for cell, used in ((70, 0.25), (71, 0.5)):
        o = observations(2500.0 + np.arange(3.0), np.arange(3), value(np.full(3, 0.5)), cell=cell)
        fusion.update(dataclasses.replace(o, used=np.full(3, used, np.float32)))
        p = belief(fusion, cell=cell)
        medians.append(float(np.interp(0.5, np.cumsum(p), np.linspace(0.086, 1.2, 32))))
    assert medians[0] > medians[1] + 0.1
    assert shared.KERNELS.shape[1:] == (32, 32)


def test_the_doubt_of_an_alarm_ends_where_the_slope_is_known_and_two_with_a_record_told_of_ice() -> None:
    fusion, _ = acquainted()
    assert slope_std(fusion.store.peers, fusion.standings[-1]) < c.SLOPE_KNOWN
    assert slope_std(Fusion(120.0).store.peers, Fusion(120.0).standings[-1]) == pytest.approx(c.SLOPE_STD)
    doubt = []
    for cell, who in ((70, [3, 4]), (71, [900, 901])):
        o = observations([2500.0, 2501.0], who, value([0.3, 0.3], 0.04), cell=cell)
        fusion.update(dataclasses.replace(o, used=np.full(2, 0.15, np.float32)))
        slot = fusion.slots_of(np.array([cell]), np.array([0]))
        doubt.append(float(np.abs(fusion.alarming(slot) - fusion.believed(slot)).max()))
    assert doubt[0] == 0.0 < doubt[1]


@pytest.mark.parametrize(("used", "witnesses"), [(0.1, 0), (0.19, 1)])
def test_who_used_most_of_the_ice_it_tells_of_is_a_witness_whatever_it_says_of_dry_road(
    used: float, witnesses: int
) -> None:
    fusion = Fusion(120.0)
    tailed = np.maximum(value([0.2], 0.04), np.where(mugrid.CENTRES > 0.5, -4.0, -12.0))
    assert np.exp(tailed)[0] @ mugrid.CENTRES / np.exp(tailed).sum() * c.WITNESS_SHARE > 0.19
    o = observations([0.0], [1], tailed)
    fusion.update(dataclasses.replace(o, used=np.array([used], np.float32)))
    slot = fusion.slots_of(o.cell, o.sector)
    assert fusion.sources(slot, ICE, 0)[0][0] == witnesses
