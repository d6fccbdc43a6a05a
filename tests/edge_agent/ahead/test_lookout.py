"""Tests of cars that look ahead, that is, receive the map of the road ahead over real Zenoh
sessions. They must give warnings from alerts and from the map, also after the router was lost.
Forged messages must give no warning.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import zenoh

from edge_agent.ahead import local_map, lookout
from edge_agent.ahead.cell_decoder import decode_alert_message, decode_cells, decode_standing_alerts
from edge_agent.ahead.lookout import Lookout
from edge_agent.ahead.path import GivenRoute, Path, Pose, straight_path
from edge_agent.ahead.request_log import (
    LEAVE_S,
    MOST_TILES,
    REFRESH_S,
    RequestLog,
    Tiles,
    keys_of,
    split_at_antimeridian,
)
from schemas import grid, keys, wire
from schemas.errors import WireError
from schemas.numeric import FloatArray, IntArray
from schemas.query import parse as parse_query
from schemas.runtime.zenoh_session import open_session
from schemas.thresholds import NS
from schemas.wire.ahead import AHEAD_ENCODING, GripWarning, Outlook, decode_ahead, encode_ahead
from tests.benchmarks.ahead.made_up_service import MadeUpService, tile_payload
from tests.edge_agent.ahead.roads import HOME, alert, keys_on, line
from tests.edge_agent.service import Router
from tests.waiting import until

CAR = "car-one"
ICE = keys_on(110.0, start=70.0)
NOW = time.time_ns()
DAY = 86_400 * NS


class Driving:
    """Car at the beginning of a road. It drives at 14 m/s and looks ahead along the road."""

    def __init__(self, router: Router) -> None:
        self.metre = 0.0
        session = open_session(router.settings)
        assert session is not None
        self.session = session
        self.warnings: queue.Queue[GripWarning] = queue.Queue()
        route = GivenRoute(*line())
        self.lookout = Lookout(
            [CAR], lambda _, warning: self.warnings.put(warning), lambda _: route
        )
        self.lookout.attach(CAR, session)
        self.report_pose()
        self.lookout.start()

    def report_pose(self, *, later_s: float = 0.0) -> None:
        """Report the car's pose (position, heading, speed) to the lookout, the thread that looks
        ahead; the pose is dated `later_s` seconds after the present.
        """
        latitude, longitude = line(self.metre + 2.0, start=self.metre)
        now = time.time_ns() + round(later_s * NS)
        self.lookout.set_poses([Pose(float(latitude[0]), float(longitude[0]), HOME.yaw, 14.0, now)])

    def drive_until(self, condition: Callable[[Outlook], object]) -> Outlook:
        """Report the car's pose (position, heading, speed) until the car's outlook (its warnings
        and the friction of the road ahead) meets the condition. Return this outlook.
        """

        def has_outlook() -> bool:
            self.report_pose()
            seen = self.lookout.latest_outlook(CAR)
            return seen is not None and bool(condition(seen))

        until(has_outlook)
        seen = self.lookout.latest_outlook(CAR)
        assert seen is not None
        return seen

    def next_warning(self) -> GripWarning:
        def has_warning() -> bool:
            self.report_pose()
            return not self.warnings.empty()

        until(has_warning)
        return self.warnings.get()


@contextmanager
def driving(router: Router) -> Iterator[Driving]:
    car = Driving(router)
    try:
        yield car
    finally:
        car.lookout.close(5.0)
        car.session.close()


@pytest.fixture
def town(router: Router) -> Iterator[MadeUpService]:
    """Yield a simulated fleet service. No cell of its map is icy at first."""
    with MadeUpService(router.settings, time.time_ns()) as town:
        yield town


def test_an_alert_ahead_is_a_warning_at_once_and_its_end_too(
    router: Router, town: MadeUpService
) -> None:
    with driving(router) as car:
        until(lambda: any("alert" in asked for asked in town.asked))
        town.put(alert(int(ICE[0]), time=NOW))
        raised = car.next_warning()
        assert raised.state == "raised"
        assert raised.reason == "an alert is active"
        assert 50.0 < raised.distance_m < 75.0
        town.put(alert(int(ICE[0]), raised=False, time=NOW + NS))
        assert car.next_warning().state == "ended"


def test_alert_causes_a_warning_at_once(
    router: Router, town: MadeUpService, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lookout, "LOOK_S", 1e6)
    monkeypatch.setattr(lookout, "STALE_S", 1e6)
    with driving(router) as car:
        until(
            lambda: car.lookout.counts.looks == 2 and any("alert" in asked for asked in town.asked)
        )
        town.put(alert(int(ICE[0]), time=NOW))
        assert car.next_warning().state == "raised"
        assert car.lookout.counts.looks == 3


def test_car_queries_active_alerts_when_it_enters_a_tile(
    router: Router, town: MadeUpService
) -> None:
    town.standing = [alert(int(key), time=NOW) for key in keys_on(2600.0, start=2560.0)]
    with driving(router) as car:
        subscriber = car.lookout.counts.subscribers[CAR]
        car.drive_until(lambda _: car.lookout.counts.looks > 1)
        before = set(subscriber.tiles)
        assert not subscriber.counts["alerts"] + car.lookout.counts.warnings
        car.metre = 2500.0
        raised = car.next_warning()
        assert (raised.state, raised.way) == ("raised", "corridor"), "it has left its route"
        assert set(subscriber.tiles) - before


def test_car_queries_ice_that_was_found_before_it_arrived(
    router: Router, town: MadeUpService
) -> None:
    town.standing = [alert(int(key), time=NOW) for key in ICE]
    with driving(router) as car:
        assert car.next_warning().mu == pytest.approx(0.15, abs=0.03)


def test_map_without_alerts_warns_and_its_values_are_on_the_horizon(
    router: Router, town: MadeUpService
) -> None:
    town.mu = {int(key): 0.85 for key in keys_on()} | {int(key): 0.15 for key in ICE}
    with driving(router) as car:
        warning = car.next_warning()
        assert warning.reason == "the map reports low grip"
        seen = car.drive_until(lambda seen: (seen.runs.basis == local_map.MEASURED).sum() > 10)
        assert seen.way == "route"
        dry = seen.runs.start_m < 60.0
        assert seen.runs.mu[dry & (seen.runs.basis == local_map.MEASURED)].min() > 0.7
        assert np.isfinite(seen.runs.safe_speed).any()
        assert all("bbox=" in asked for asked in town.asked if "/map/" in asked), (
            "pieces, never the whole map"
        )


def test_warnings_are_published_on_the_vehicles_own_key(
    router: Router, town: MadeUpService
) -> None:
    town.standing = [alert(int(ICE[0]), time=NOW)]
    owner = open_session(router.settings)
    assert owner is not None
    samples: list[zenoh.Sample] = []

    def find_warnings() -> list[zenoh.Sample]:
        return [sample for sample in samples if decode_ahead(sample.payload.to_bytes()).warnings]

    with owner:
        owner.declare_subscriber(keys.ahead_key(CAR), samples.append)
        with driving(router) as car:
            assert car.next_warning().state == "raised"
            car.drive_until(lambda _: find_warnings())
    sample = find_warnings()[0]
    assert str(sample.encoding) == AHEAD_ENCODING
    outlook = decode_ahead(sample.payload.to_bytes())
    assert outlook.vehicle == CAR
    assert outlook.warnings[0].state == "raised"
    assert encode_ahead(outlook) == sample.payload.to_bytes()


def test_ice_during_a_router_outage_is_received_after_reconnect(
    router: Router, town: MadeUpService
) -> None:
    with driving(router) as car:
        until(lambda: any("alert" in asked for asked in town.asked))
        router.stop()
        with town.lock:
            town.standing = [alert(int(key), time=NOW) for key in ICE]
        before = len(town.asked)
        router.start()
        assert car.next_warning().state == "raised"
        assert any("alert" in asked for asked in town.asked[before:])


def test_service_that_starts_after_the_car_is_queried_too(router: Router) -> None:
    with driving(router) as car:
        until(lambda: car.lookout.counts.looks > 1)
        with MadeUpService(router.settings, time.time_ns()) as town:
            town.standing = [alert(int(key), time=NOW) for key in ICE]
            assert car.next_warning().state == "raised"


def test_without_a_link_the_horizon_fades_to_unknown_and_the_car_looks_on(
    router: Router, town: MadeUpService
) -> None:
    town.mu = {int(key): 0.85 for key in keys_on()}
    with driving(router) as car:
        car.drive_until(lambda seen: (seen.runs.basis == local_map.MEASURED).sum() > 10)
        router.stop()
        car.lookout.set_poses(
            [HOME._replace(time=time.time_ns() + round((local_map.HELD_S + 60.0) * NS))]
        )
        looks = car.lookout.counts.looks
        until(lambda: car.lookout.counts.looks > looks + 1)
        seen = car.lookout.latest_outlook(CAR)
        assert seen is not None
        assert not seen.runs.basis.any()
        assert np.isnan(seen.runs.mu_lower).all()
        assert np.isnan(seen.runs.safe_speed).all()
        assert not car.lookout.counts.failures
        router.start()


def test_cell_observed_yesterday_states_its_age(router: Router) -> None:
    with MadeUpService(router.settings, time.time_ns() - DAY) as town:
        town.mu = {int(key): 0.85 for key in keys_on()}
        with driving(router) as car:
            seen = car.drive_until(lambda seen: (seen.runs.basis == local_map.MEASURED).any())
            assert np.nanmin(seen.runs.age_s) == pytest.approx(86_400.0, rel=0.01)


def test_a_map_of_yesterday_neither_warns_nor_replaces_that_of_today(router: Router) -> None:
    """A map with ice from yesterday must cause no warning. A map from yesterday must not replace
    today's map.
    """
    yesterday = {int(key): 0.85 for key in keys_on()} | {int(key): 0.15 for key in ICE}
    with driving(router) as car:
        with MadeUpService(router.settings, time.time_ns() - DAY, yesterday, kept=True):
            car.drive_until(lambda _: car.lookout.counts.total_of("cells") > 10)
            looks = car.lookout.counts.looks
            seen = car.drive_until(lambda _: car.lookout.counts.looks > looks + 1)
            assert not seen.runs.basis.any(), "nobody knows what it is like today"
            assert np.isnan(seen.runs.safe_speed).all()
            assert not seen.warnings
        subscriber = car.lookout.counts.subscribers[CAR]
        now = time.time_ns()
        key = keys.map_key(TILE)
        for when, mu in ((now, 0.15), (now - DAY, 0.85)):
            with subscriber.map_lock():
                subscriber.local_map.store_cells(
                    *decode_cells(key, tile_payload(HERE, mu, when), now), now
                )
        assert car.next_warning().mu == pytest.approx(0.15, abs=0.03)


def test_where_it_is_the_car_believes_its_filter_and_the_map(
    router: Router, town: MadeUpService
) -> None:
    town.mu = {int(key): 0.2 for key in keys_on()}
    place = np.array([keys_on()[0]])
    flat = (np.zeros((1, 32)), np.zeros((1, 32)))
    with driving(router) as car:
        car.lookout.combine_beliefs(np.array([-1]), flat)
        car.drive_until(lambda seen: (seen.runs.basis == local_map.MEASURED).sum() > 10)
        outlook = car.lookout.latest_outlook(CAR)
        assert outlook is not None
        assert outlook.here[0] == pytest.approx(0.625, abs=0.02)

        def is_informed(seen: Outlook) -> bool:
            # As in the agent, `combine_beliefs` is called for each block. It skips the map while
            # another thread has locked it.
            car.lookout.combine_beliefs(place, flat)
            return bool(seen.here[0] < 0.3)

        seen = car.drive_until(is_informed)
        assert seen.here[2] > 0.7, "a map may be wrong"


def test_hostile_alert_is_refused_and_counted(router: Router, town: MadeUpService) -> None:
    town.mu = {int(key): 0.15 for key in ICE}
    with driving(router) as car:
        assert car.next_warning().state == "raised"
        tile = int(grid.tile_of(ICE[0] // grid.SECTORS))
        until(lambda: town.session.get(keys.alert_key(tile)) is not None)
        town.session.put(keys.alert_key(tile), b"\xff" * 300)
        far = alert(int(ICE[0]) + (1 << 30), time=NOW)
        town.session.put(keys.alert_key(tile), wire.encode_alert(far))
        until(
            lambda: (
                sum(
                    n
                    for name, n in car.lookout.counts.subscribers[CAR].counts.items()
                    if "refused" in name
                )
                >= 2
            )
        )
        assert car.lookout.counts.values()["heard_refused"] >= 2
        assert car.drive_until(lambda seen: seen.warnings).warnings[0].state == "raised"


TILE = int(grid.tile_of(ICE[0] // grid.SECTORS))
HERE = ICE[grid.tile_of(ICE // grid.SECTORS) == TILE]
ONE = np.ones(len(HERE))
LIES = {
    "a cell elsewhere": {"cell": HERE // grid.SECTORS + (1 << 20)},
    "a sector that is none": {"sector": ONE * 9},
    "grip without end": {"mu_upper": ONE * np.inf},
    "no number": {"mu_lower": ONE * np.nan},
    "ends crossed": {"mu_lower": ONE * 0.9, "mu": ONE * 0.5},
    "more than certain": {"p_slippery": ONE * 2.0},
    "nobody": {"vehicles": ONE * 0},
    "tomorrow": {"last_time": np.full(len(HERE), NOW + 86_400 * NS)},
    "another basis": {"basis": ["surely"] * len(HERE)},
    "older than the world": {"age_s": ONE * np.inf},
    "a bound with a value": {"basis": ["bound"] * len(HERE)},
    "the same place twice": {"cell": np.repeat(HERE[:1] // grid.SECTORS, len(HERE))},
}


NOISE = (b"", b"\x00" * 100, b"\xff" * 10_000, tile_payload(HERE, 0.2, NOW)[:-40])


@pytest.mark.parametrize("lie", LIES)
def test_a_tile_that_is_not_possible_is_not_believed(lie: str) -> None:
    key = keys.map_key(TILE)
    assert decode_cells(key, tile_payload(HERE, 0.2, NOW), NOW)[0] == TILE
    with pytest.raises(WireError):
        decode_cells(key, tile_payload(HERE, 0.2, NOW, **LIES[lie]), NOW)


@pytest.mark.parametrize("payload", NOISE)
def test_bytes_that_are_no_tile_are_refused(payload: bytes) -> None:
    with pytest.raises(WireError):
        decode_cells(keys.map_key(TILE), payload, NOW)
    with pytest.raises(WireError):
        decode_cells(keys.alert_key(TILE), tile_payload(HERE, 0.2, NOW), NOW)


class Liar(MadeUpService):
    """Simulated malicious service. It answers map queries with different invalid tiles, one after
    the other, ending with an empty tile.
    """

    answers = 0

    def tile_answer(self, key: IntArray, mu: FloatArray) -> bytes:
        self.answers += 1
        lies = [tile_payload(HERE, 0.2, NOW, **lie) for lie in LIES.values()]
        return [*lies, *NOISE, tile_payload(HERE[:0], 0.2, NOW)][
            self.answers % (len(LIES) + len(NOISE) + 1)
        ]


def test_hostile_tiles_are_refused_and_ice_is_still_received(router: Router) -> None:
    every = len(LIES) + len(NOISE) + 1
    with (
        Liar(router.settings, time.time_ns(), {int(key): 0.85 for key in keys_on()}) as liar,
        driving(router) as car,
    ):
        later_s = 0.0
        while liar.answers < every:  # after REFRESH_S the car requests the map part again
            before = liar.answers
            later_s = later_s + REFRESH_S + 1.0
            car.report_pose(later_s=later_s)
            until(lambda before=before: liar.answers > before)  # type: ignore[misc]
        until(lambda: car.lookout.counts.values()["heard_refused"] >= every - 1)
        assert not car.lookout.counts.total_of("cells")
        # The last pose was dated an hour ahead. Until a pose of now arrives, an alert of now would
        # count as expired.
        car.drive_until(lambda seen: seen.time < time.time_ns() + NS)
        liar.put(alert(int(ICE[0]), time=time.time_ns()))
        assert car.next_warning().state == "raised"
        assert not car.lookout.counts.failures


def test_alerts_that_are_not_possible_are_refused() -> None:
    good = alert(int(HERE[0]), time=NOW)
    key = keys.alert_key(TILE)
    assert (
        decode_alert_message(key, wire.encode_alert(good), NOW)
        == decode_standing_alerts(key, wire.encode_standing([good]), NOW)[1][0]
    )
    for name, value in (
        ("mu", float("nan")),
        ("p_slippery", 3.0),
        ("sector", 7),
        ("time", NOW + 3600 * NS),
        ("cell", 5),
    ):
        lie = wire.Alert(**(vars(good) | {name: value}))
        with pytest.raises(WireError):
            decode_alert_message(key, wire.encode_alert(lie), NOW)
        with pytest.raises(WireError):
            decode_standing_alerts(key, wire.encode_standing([good, lie]), NOW)


def _at(metre: float, seconds: float) -> Pose:
    latitude, longitude = line(max(metre + 1.0, 2.0))
    return HOME._replace(
        latitude=float(latitude[int(metre)]),
        longitude=float(longitude[int(metre)]),
        time=NOW + round(seconds * NS),
    )


def test_boxes_ahead_are_requested_once_and_again_when_old() -> None:
    asked = RequestLog()
    pose = _at(0, 0)
    path = straight_path(pose, 150.0)
    boxes = asked.missing_boxes(path, pose, 100.0)
    assert 1 <= len(boxes) <= 6
    latitude, longitude = line(150.0)
    covered = np.zeros(150, bool)
    for box in boxes:
        covered |= (
            (latitude >= box.south)
            & (latitude <= box.north)
            & (longitude >= box.west)
            & (longitude <= box.east)
        )
    assert covered.all()
    assert asked.missing_boxes(path, pose, 100.0) == []
    assert asked.missing_boxes(
        path, pose._replace(time=pose.time + round((REFRESH_S + 1) * NS)), 100.0
    )
    asked.request_again()
    assert asked.missing_boxes(path, pose, 100.0), "the session has come back"


@pytest.mark.parametrize("longitude", [179.9995, -179.9995])
def test_boxes_over_the_antimeridian_are_requested_on_both_sides(longitude: float) -> None:
    yaw = 0.0 if longitude > 0.0 else np.pi
    pose = Pose(-16.8, longitude, yaw, 14.0, NOW)
    boxes = RequestLog().missing_boxes(straight_path(pose, 150.0), pose, 100.0)
    parts = [part for box in boxes for part in split_at_antimeridian(box)]
    for part in parts:
        assert parse_query({"bbox": ",".join(map(str, part))}).bbox == part
    west = grid.region_of(grid.cell_of(-16.8, 179.9))
    east = grid.region_of(grid.cell_of(-16.8, -179.9))
    assert {key for part in parts for key in keys_of(part)} == {west, east}
    assert [keys_of(part)[0] for part in parts if part.west < 0.0] == [east]


def test_few_tiles_are_subscribed_and_a_border_causes_no_flicker() -> None:
    tiles = Tiles()
    begun = 0
    ceased = 0
    for second in range(600):
        metre = 40.0 * second
        pose = _at(metre, second)
        paths: list[Path] = [straight_path(pose, 150.0)]
        fresh, gone = tiles.update_subscriptions(paths, pose)
        begun = begun + len(fresh)
        ceased = ceased + len(gone)
        assert len(tiles.subscribed_tiles) <= MOST_TILES
        assert len(tiles.subscribed_tiles) == begun - ceased
    assert 15 < begun < 60, "24 km over tiles of 1.3 km"
    border = Tiles()
    flickers = 0
    west, _, _, _ = (float(side) for side in grid.bounds(TILE, grid.TILE_ZOOM))
    for second in range(100):
        pose = HOME._replace(
            longitude=west + 2e-6 * (-1) ** second, yaw=np.pi / 2, time=NOW + second * NS
        )
        flickers += sum(map(len, border.update_subscriptions([straight_path(pose, 150.0)], pose)))
    assert flickers <= 4
    assert LEAVE_S > 2.0
