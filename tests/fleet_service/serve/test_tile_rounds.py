"""Tests of the rounds in which the service publishes tiles. Rounds begin at regular times, and each
changed tile is published in some round. The publication takes at most a fixed share of each pass of
the service's main loop.
"""

from __future__ import annotations

from fleet_service.counts import ServiceCounts
from fleet_service.serve.tile_rounds import SHARE_S, TileRounds

COST_S = SHARE_S / 2.0  # time to make a tile


class Made:
    """Simulated environment for tests of the publication rounds. It has a set of changed tiles, a
    clock that the test advances, and a list of the published tiles with their times.
    """

    def __init__(self) -> None:
        self.now = 100.0
        self.changed = set[int]()
        self.puts = list[tuple[int, float]]()
        self.counts = ServiceCounts()
        self.rounds = TileRounds(1.0, self.take, self.put, self.counts, lambda: self.now)

    def take(self) -> list[int]:
        taken = sorted(self.changed)
        self.changed = set()
        return taken

    def put(self, waiting: list[int]) -> int:
        self.puts.append((waiting[0], self.now))
        self.now += COST_S
        return 1

    def turn(self, seconds: float = 0.0) -> int:
        """Simulate one pass of the service's main loop: other work for `seconds`, and then the
        publication of tiles. Return the number of published tiles.
        """
        self.now += seconds
        before = len(self.puts)
        self.rounds.begin()
        self.rounds.go_on()
        return len(self.puts) - before


def test_a_turn_puts_at_most_its_share_and_every_tile_has_its_turn() -> None:
    made = Made()
    made.changed = set(range(1000))
    turns = [made.turn(0.01) for _ in range(1000)]
    assert max(turns) == 2
    assert sorted(tile for tile, _ in made.puts) == list(range(1000))


def test_skipped_tile_rounds_are_counted_and_changes_come_in_the_next() -> None:
    made = Made()
    # The tiles alone take three seconds, and the other work of the loop takes as long.
    made.changed = set(range(300))
    while len(made.puts) < 300:
        made.turn(SHARE_S)
        made.changed |= {3, 5}
    skipped = made.counts.tile_rounds_skipped
    assert skipped >= 2
    while made.rounds.waiting or len(made.puts) == 300:
        made.turn(SHARE_S)
    assert [tile for tile, _ in made.puts[300:]] == [3, 5]
    assert made.counts.tile_rounds_skipped == skipped


def test_time_of_a_publication_does_not_reveal_the_time_of_a_visit() -> None:
    moments = []
    for passed in (0.13, 0.64, 0.97):
        made = Made()
        while not made.puts:
            if made.now >= 100.0 + passed:
                made.changed = {7}
            made.turn(0.01)
        moments.append(round(made.puts[0][1], 6))
    assert len(set(moments)) == 1


def test_a_stalled_worker_begins_one_round_and_counts_the_missed_ones() -> None:
    made = Made()
    made.changed = {7}
    made.turn(5.5)
    assert [tile for tile, _ in made.puts] == [7]
    assert made.counts.tile_rounds_skipped == 4
    made.changed = {8}
    assert made.turn(0.3) == 0
    assert made.turn(0.3) == 1


def test_stopping_service_publishes_remaining_tiles_once_each() -> None:
    made = Made()
    made.changed = {1, 2, 3, 4, 5}
    made.turn(1.0)
    made.changed = {5, 6}
    made.rounds.finish(1.0)
    assert [tile for tile, _ in made.puts] == [1, 2, 3, 4, 5, 6]


def test_each_tile_is_published_once_per_round() -> None:
    puts: list[int] = []

    def put_two(waiting: list[int]) -> int:
        puts.extend(waiting[:2])
        return len(waiting[:2])

    rounds = TileRounds(1.0, lambda: [1, 2, 3, 4, 5], put_two, ServiceCounts(), lambda: 0.0)
    rounds.finish(1.0)
    assert puts == [1, 2, 3, 4, 5]
    assert not rounds.waiting
