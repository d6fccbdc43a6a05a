"""Tests of the presence of regions. Every client learns which regions are served from liveliness
tokens (signs of connected services). Three services run, and one of them stops.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zenoh

from fleet_service.app.endpoints import Endpoints
from fleet_service.cli import main
from fleet_service.client import map_client, watching
from fleet_service.shards.serving import announce_regions, claim_regions, rival_tokens
from schemas import grid, keys, query, regions
from schemas.config import ZenohSettings
from schemas.errors import InputError
from schemas.runtime import presence
from schemas.wire import Batch
from tests.fleet_service.conftest import Running, running
from tests.fleet_service.examples import SECOND, batch, send
from tests.waiting import until

# Three neighbouring regions. The street begins in the east, so that its order differs from every
# order of the tiles.
MIDDLE = int(grid.region_of(int(grid.cell_of(57.7, 11.97))))
COLUMN, ROW = (int(one) for one in grid.deinterleave(MIDDLE))
REGIONS = grid.interleave(np.array([COLUMN - 1, COLUMN, COLUMN + 1]), np.array([ROW] * 3)).tolist()
NAMES = [keys.chunks(region, grid.REGION_ZOOM) for region in REGIONS]
WEST, SOUTH, EAST, NORTH = (float(side) for side in grid.bounds(MIDDLE, grid.REGION_ZOOM))
LATITUDE = (SOUTH + NORTH) / 2
ROUTE = "|".join(
    f"{longitude:.6f},{LATITUDE:.6f}" for longitude in (EAST + 0.03, EAST - 0.03, WEST - 0.03)
)
LONGITUDES = (
    WEST - 0.02,
    WEST - 0.01,
    WEST + 0.01,
    WEST + 0.02,
    EAST - 0.02,
    EAST - 0.01,
    EAST + 0.01,
    EAST + 0.02,
)
CARS = 3


@pytest.fixture(autouse=True)
def nobody(session: zenoh.Session) -> None:
    """Wait until the router knows no service by its liveliness token (sign of a connected service).
    The router may learn late that the services of the previous test have ended.
    """
    until(lambda: not presence.active_tokens(session))


def visits(vehicle: str) -> list[Batch]:
    """Return one batch for each place of the street, with vehicle names that begin with `vehicle`.
    Each batch is from another car, because one car cannot be at several places at once.
    """
    now = time.time_ns() - 2 * SECOND
    out = list[Batch]()
    for number, longitude in enumerate(LONGITUDES):
        cell = int(grid.cell_of(LATITUDE, longitude))
        region = int(grid.region_of(cell))
        place: dict[str, Any] = {"cell": [cell], "latitude": [LATITUDE], "longitude": [longitude]}
        made = batch(f"{vehicle}-{number}", 1, now, [0.7], **place, sector=[2], yaw=[np.pi])
        out.append(replace(made, region=region))
    return out


@contextmanager
def three(router: ZenohSettings, folder: Path) -> Iterator[list[Running]]:
    with ExitStack() as stack:
        yield [
            stack.enter_context(
                running(router, folder / f"shard-{i}", name=f"shard-{i}", regions=[name])
            )
            for i, name in enumerate(NAMES)
        ]


def drive(session: zenoh.Session, services: list[Running]) -> None:
    for car in range(CARS):
        for made in visits(f"sim-{car:03}"):
            send(session, made, keys.observation_key(made.region, made.vehicle))
    wanted = CARS * len(LONGITUDES)
    until(lambda: sum(run.service.engine.counts.observations for run in services) == wanted)


def ask(router: ZenohSettings, **parameters: str) -> map_client.Answer:
    return map_client.query_map(router, parameters)


def test_answers_over_three_services_are_ordered_and_name_gaps(
    router: ZenohSettings,
    session: zenoh.Session,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    box = f"{WEST - 0.05},{SOUTH},{EAST + 0.05},{NORTH}"
    dead = f"{WEST + 0.001},{SOUTH + 0.001},{EAST - 0.001},{NORTH - 0.001}"
    lines: list[str] = []
    stop = threading.Event()
    wishes = watching.WatchOptions(box, as_json=True)
    watcher = threading.Thread(target=watching.watch_map, args=(router, wishes, stop, lines.append))
    try:
        with three(router, tmp_path) as services:
            drive(session, services)
            along = ask(router, route=ROUTE)
            assert along.missing == ()
            assert along.table is not None
            passed = np.asarray(along.table["longitude"].to_numpy())
            assert (np.diff(passed) < 0).all()
            assert along.table.num_rows == len(LONGITUDES)
            for form in ("json", "geojson"):
                document: Any = ask(router, route=ROUTE, format=form).document
                assert document is not None
                cells = [cell for tile in document.get("tiles", []) for cell in tile["cells"]]
                cells += [one["properties"] for one in document.get("features", [])]
                assert [cell["longitude"] for cell in cells] == passed.tolist()
            assert ask(router, bbox=box).gap_description is None
            watcher.start()
            until(lambda: any(json.loads(line)["event"] == "watching" for line in lines))
            services[1].end()
            silent = 0
            asked = [
                {"bbox": box},
                {"bbox": dead},
                {"route": ROUTE},
                {"bbox": dead, "format": "json"},
            ]
            for parameters in asked:
                answer = ask(router, **parameters)
                silent += answer.missing != (NAMES[1],)
            assert silent == 0  # this is the figure `cluster.silent_regions`
            part = ask(router, route=ROUTE).table
            assert part is not None
            assert 0 < part.num_rows < along.table.num_rows
            with pytest.raises(InputError, match=NAMES[1]):
                map_client.served_table(ask(router, bbox=dead))
            assert map_client.served_table(ask(router, bbox=box)).schema.metadata == {
                b"missing": NAMES[1].encode()
            }
            assert main(["query", "--connect", router.connect[0], "--bbox", dead]) == 1
            assert f"no service answers for {NAMES[1]}" in capsys.readouterr().err
            until(lambda: {"event": "away", "regions": [NAMES[1]]} in map(json.loads, lines))
            with running(router, tmp_path / "shard-1", name="shard-1", regions=[NAMES[1]]):
                assert ask(router, bbox=box).gap_description is None
                until(lambda: {"event": "back", "regions": [NAMES[1]]} in map(json.loads, lines))
    finally:
        stop.set()
        if watcher.is_alive():
            watcher.join(10.0)


@pytest.mark.campaign
def test_a_second_service_of_a_region_refuses_to_start(
    router: ZenohSettings, tmp_path: Path
) -> None:
    wide = NAMES[1].rpartition("/")[0] + "/*"

    def assert_refused(name: str) -> None:
        with (
            pytest.raises(
                InputError, match=f"{NAMES[1].rpartition('/')[0]}.* is already served by first"
            ),
            zenoh_session(router) as other,
            claim_regions(other, name, NAMES[1:2], threading.Event()),
        ):
            pass

    with (
        running(router, tmp_path / "one", name="first", regions=[wide]),
        ThreadPoolExecutor() as both,
    ):
        # A service of the same name on another machine is refused, too.
        list(both.map(assert_refused, ("first", "second")))
    with (
        zenoh_session(router) as other,
        claim_regions(other, "second", NAMES[1:2], threading.Event()) as mine,
    ):
        assert presence.active_tokens(other) == set()
        with (
            pytest.raises(InputError, match="already served by second"),
            zenoh_session(router) as third,
            claim_regions(third, "third", NAMES[1:2], threading.Event()),
        ):
            pass
        with announce_regions(other, mine):
            assert presence.active_tokens(other) == set(mine)
        assert rival_tokens(mine, presence.active_tokens(other)) == []


def test_region_is_announced_only_while_queries_are_answered(
    router: ZenohSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []
    answering = Endpoints.declare_all

    @contextmanager
    def record_tokens(endpoints: Endpoints, session: zenoh.Session) -> Iterator[None]:
        with answering(endpoints, session):
            seen.append(presence.active_tokens(session))
            yield
            until(lambda: not presence.active_tokens(session))
            seen.append(set())

    monkeypatch.setattr(Endpoints, "declare_all", record_tokens)
    with (
        running(router, tmp_path / "one", name="first", regions=NAMES[:1]),
        zenoh_session(router) as other,
    ):
        until(lambda: {token.service for token in presence.active_tokens(other)} == {"first"})
    assert seen == [set(), set()]


@pytest.mark.parametrize("late", [False, True])
def test_service_that_appears_during_a_query_may_have_missed_it(
    router: ZenohSettings, monkeypatch: pytest.MonkeyPatch, late: bool
) -> None:
    inside = f"{WEST + 0.001},{SOUTH + 0.001},{EAST - 0.001},{NORTH - 0.001}"
    with zenoh_session(router) as other, zenoh_session(router) as third:
        mine = frozenset({keys.ServiceToken(NAMES[1], "late", "1f")})
        coming = announce_regions(other, mine)

        def let_come(*_: object) -> bool:
            coming.__enter__()
            until(lambda: presence.active_tokens(third) == mine)
            return True

        with monkeypatch.context() as meanwhile:
            meanwhile.setattr(
                map_client, "query_replies", lambda *_: iter([] if late else [let_come()][1:])
            )
            meanwhile.setattr(map_client, "is_served", let_come)
            answer = ask(router, bbox=inside)
        assert (answer.gap_description is None, answer.served) == (False, False)
        coming.__exit__(None, None, None)


def test_service_found_after_an_empty_answer_is_queried_again(
    router: ZenohSettings, session: zenoh.Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The client's first query returns nothing, because the test replaces its replies with an empty
    list. The client must not report a missing service. It must check if a service answers in this
    area, find the service, and send the query again.

    The service has no liveliness token (sign of a connected service), so that the client cannot
    find it by its token.
    """
    monkeypatch.setattr("fleet_service.app.service.announce_regions", lambda *_: nullcontext())
    with running(router, tmp_path / "one", name="first", regions=NAMES[1:2]) as service:
        drive_one(session, service)
        asked = map_client.query_replies
        first = [True]

        def replies(*given: Any) -> Iterator[tuple[str, bytes]]:  # noqa: ANN401
            found = [] if first.pop() else list(asked(*given))
            first.append(False)
            return iter(found)

        monkeypatch.setattr(map_client, "query_replies", replies)
        answer = ask(router, bbox=f"{WEST + 0.001},{SOUTH + 0.001},{EAST - 0.001},{NORTH - 0.001}")
        assert answer.table is not None
        assert answer.table.num_rows > 0


def drive_one(session: zenoh.Session, service: Running) -> None:
    """Publish a car's batches for the middle region, and wait until the service has acknowledged
    them.
    """
    own = [made for made in visits("sim-000") if made.region == REGIONS[1]]
    for made in own:
        send(session, made, keys.observation_key(made.region, made.vehicle))
    until(lambda: service.service.engine.counts.observations == len(own))


@pytest.mark.parametrize("comes_back", [False, True])
def test_query_during_a_handover_may_reach_the_leaving_service(
    router: ZenohSettings, monkeypatch: pytest.MonkeyPatch, comes_back: bool
) -> None:
    inside = f"{WEST + 0.001},{SOUTH + 0.001},{EAST - 0.001},{NORTH - 0.001}"
    frozen, follows = (
        frozenset({keys.ServiceToken(NAMES[1], name, "1f")}) for name in ("frozen", "follows")
    )
    with (
        zenoh_session(router) as other,
        zenoh_session(router) as third,
        announce_regions(other, follows),
    ):
        held = announce_regions(other, frozen)
        again = announce_regions(other, frozen)
        held.__enter__()
        until(lambda: len(presence.active_tokens(third)) == 2)

        def replies(*_: object) -> Iterator[tuple[str, bytes]]:
            held.__exit__(None, None, None)
            until(lambda: len(presence.active_tokens(third)) == 1)
            if comes_back:  # a frozen service resumes
                again.__enter__()
                until(lambda: len(presence.active_tokens(third)) == 2)
            return iter(())

        with monkeypatch.context() as meanwhile:
            meanwhile.setattr(map_client, "query_replies", replies)
            assert ask(router, bbox=inside).gap_description is not None
        assert ask(router, bbox=inside).gap_description is None
        if comes_back:
            again.__exit__(None, None, None)


def test_token_of_a_killed_service_may_fall_after_the_answer(
    router: ZenohSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    inside = f"{WEST + 0.001},{SOUTH + 0.001},{EAST - 0.001},{NORTH - 0.001}"
    with zenoh_session(router) as other, zenoh_session(router) as third:
        held = announce_regions(other, frozenset({keys.ServiceToken(NAMES[1], "killed", "1f")}))
        held.__enter__()
        until(lambda: len(presence.active_tokens(third)) == 1)

        def falls(_: float) -> None:
            held.__exit__(None, None, None)
            until(lambda: not presence.active_tokens(third))

        monkeypatch.setattr(map_client, "query_replies", lambda *_: iter(()))
        monkeypatch.setattr(map_client, "time", SimpleNamespace(sleep=falls))
        assert ask(router, bbox=inside).gap_description is not None


@contextmanager
def zenoh_session(router: ZenohSettings) -> Iterator[zenoh.Session]:
    with map_client.open_connected(router) as opened:
        yield opened


def test_unserved_area_is_named_with_the_fewest_regions() -> None:
    box = query.parse({"bbox": f"{WEST + 0.01},{SOUTH + 0.01},{EAST + 0.02},{NORTH - 0.01}"})
    first = NAMES[1].split("/")
    assert regions.unserved_expressions(box, ["*/*/*"]) == []
    assert regions.unserved_expressions(box, NAMES) == []
    assert regions.unserved_expressions(box, NAMES[:2]) == [
        NAMES[2]
    ] or regions.unserved_expressions(box, NAMES[:2])[0].endswith("*")
    assert set(regions.unserved_expressions(box, [])) == {
        f"{name.split('/')[0]}/*/*" for name in NAMES[1:]
    }
    assert regions.unserved_expressions(query.parse({}), [f"{first[0]}/*/*"]) == [
        f"{grid.quadkey(one, 4)}/*/*" for one in range(256) if grid.quadkey(one, 4) != first[0]
    ]
    assert regions.unserved_expressions(query.parse({"route": ROUTE}), [NAMES[2]]) == [
        NAMES[1],
        NAMES[0],
    ]


def test_service_token_round_trips_and_invalid_tokens_raise() -> None:
    for region in ("*/*/*", NAMES[0], "1202/*/*"):
        token = keys.ServiceToken(region, "shard-0", "1f")
        assert keys.parse_served(token.key) == token
    for key in (
        "gripmap/v1/shard/shard-0",
        f"{keys.SERVES}/1202/all/x/a/b",
        f"{keys.SERVES}/1/2/3",
        keys.SERVES,
    ):
        with pytest.raises(InputError):
            keys.parse_served(key)
