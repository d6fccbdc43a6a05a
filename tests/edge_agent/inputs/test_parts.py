"""Tests that consecutive files of one drive become one log, whatever their order, and that no file
is ignored without a word.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from edge_agent.inputs.merge import Merged, merge_recordings
from edge_agent.inputs.profile import Channel, Profile
from edge_agent.inputs.recording import Recording, Series
from schemas.errors import InputError

SECOND_NS = 1_000_000_000
START_NS = 1_780_000_000 * SECOND_NS
PROFILE = Profile(name="own", channels={"ax": Channel(signal="ax"), "ay": Channel(signal="ay")})


def make_part(
    name: str, first: float, seconds: float = 10.0, *, start: float | None = 0.0, rate: float = 10.0
) -> Recording:
    """Return a recording whose `ax` is the time of the drive: `start` plus the recorder's clock,
    which begins at `first`.
    """
    t = first + np.arange(round(seconds * rate)) / rate
    ax = t + (start or 0.0)
    dated = None if start is None else START_NS + round(start * SECOND_NS)
    return Recording(name, {"ax": Series(t, ax), "ay": Series(t, -ax)}, dated, rows=True)


def merge_parts(*parts: Recording, profile: Profile = PROFILE, **shifts: float) -> Merged:
    return merge_recordings(parts, profile, shifts={f"{k}.csv": v for k, v in shifts.items()})


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_dated_parts_are_joined_in_the_order_of_their_dates(order: tuple[int, ...]) -> None:
    parts = [make_part(f"{k}.csv", 0.0, start=10.0 * k) for k in range(3)]
    merged = merge_parts(*(parts[k] for k in order))
    assert np.allclose(merged.columns["ax"], np.arange(300) / 10.0)
    assert np.allclose(merged.t, np.arange(300) / 10.0)
    assert merged.start_ns == START_NS
    assert merged.notes == [
        "1.csv: continues 0.csv after 0.10 s",
        "2.csv: continues 1.csv after 0.10 s",
    ]


def test_parts_of_a_continuing_clock_need_no_date() -> None:
    merged = merge_parts(make_part("a.csv", 0.0, start=None), make_part("b.csv", 10.0, start=None))
    assert np.allclose(merged.columns["ax"], np.arange(200) / 10.0)


def test_undated_parts_of_unknown_order_need_a_clock() -> None:
    parts = make_part("a.csv", 0.0, start=None), make_part("b.csv", 0.0, start=None)
    with pytest.raises(InputError, match="b.csv: has the signals and .* --clock b.csv=SECONDS"):
        merge_parts(*parts)
    merged = merge_parts(*parts, b=12.0)
    assert merged.t[-1] == pytest.approx(21.9)
    assert len(merged.t) == 200


def test_readings_in_both_parts_are_taken_once() -> None:
    merged = merge_parts(make_part("a.csv", 0.0), make_part("b.csv", 0.0, start=8.0))
    assert np.allclose(merged.columns["ax"], np.arange(180) / 10.0)


def test_missing_signal_of_a_part_is_missing_in_its_rows() -> None:
    first = make_part("a.csv", 0.0)
    second = make_part("b.csv", 0.0, start=10.0)
    del second.signals["ay"]
    merged = merge_parts(first, second)
    assert np.isnan(merged.columns["ay"]).sum() == 100
    assert np.isfinite(merged.columns["ax"]).all()


def test_pause_within_a_drive_has_no_interpolated_rows() -> None:
    sparse = [make_part(f"{k}.csv", 0.0, start=60.0 * k) for k in range(2)]
    for one in sparse:
        one.rows = False
    merged = merge_parts(*sparse)
    unknown = np.isnan(merged.columns["ax"])
    assert unknown[(merged.t > 10.0) & (merged.t < 59.9)].all()
    assert np.isfinite(merged.columns["ax"][merged.t > 60.05]).all()


def test_files_of_two_drives_are_refused() -> None:
    with pytest.raises(InputError, match="b.csv: begins 3590 s after the end of a.csv; import"):
        merge_parts(make_part("a.csv", 0.0), make_part("b.csv", 0.0, start=3600.0))


def test_part_continues_the_nearest_of_two_sources() -> None:
    short = make_part("short.csv", 0.0)
    long = make_part("long.csv", 0.0, seconds=800.0, start=1.0)
    merged = merge_parts(short, long, make_part("next.csv", 0.0, start=801.0))
    assert "next.csv: continues long.csv after 0.10 s" in merged.notes


def test_parts_with_different_units_are_refused() -> None:
    second = make_part("b.csv", 0.0, start=10.0)
    second.signals["ax"] = dataclasses.replace(second.signals["ax"], unit="g")
    with pytest.raises(InputError, match="ax: has different units: '' in a.csv, 'g' in b.csv"):
        merge_parts(make_part("a.csv", 0.0), second)


def test_second_source_of_the_same_time_is_noted_as_unused() -> None:
    merged = merge_parts(make_part("a.csv", 0.0), make_part("b.csv", 0.0, start=1.0))
    assert merged.notes == ["b.csv: no channel is taken from it"]
    assert merged.t[-1] == pytest.approx(9.9)


def test_source_that_the_profile_names_is_not_joined() -> None:
    channels = {
        "ax": Channel(signal="ax", source="a.csv"),
        "ay": Channel(signal="ay", source="b.csv"),
    }
    named = Profile(name="own", channels=channels)
    merged = merge_parts(
        make_part("a.csv", 0.0, start=None), make_part("b.csv", 0.0, start=None), profile=named
    )
    assert np.allclose(merged.columns["ay"], -merged.columns["ax"])
