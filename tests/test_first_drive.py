"""Tests of the tutorial's first drive: few commands, no alert, and no slippery cell on the map."""

from __future__ import annotations

import pytest

from tests.first_drive import Cells, map_first_drive, read_commands
from tests.test_end_to_end import VEHICLES

MOST_COMMANDS = 5


@pytest.fixture(scope="module")
def minute(tmp_path_factory: pytest.TempPathFactory) -> tuple[Cells, list[str]]:
    """Publish the tutorial's recording, one minute of real driving. Return the cells of the map and
    the keys of the alerts.
    """
    return map_first_drive(tmp_path_factory.mktemp("minute"))


def test_recorded_minute_is_on_the_map_under_three_vehicle_names(
    minute: tuple[Cells, list[str]],
) -> None:
    cells, _ = minute
    assert len(cells) > 30
    assert max(int(str(cell["vehicles"])) for cell in cells) == len(VEHICLES)


def test_a_dry_road_raises_no_alert(minute: tuple[Cells, list[str]]) -> None:
    assert not minute[1]


def test_first_drive_of_the_tutorial_has_few_commands_all_tested() -> None:
    assert 0 < len(read_commands()) <= MOST_COMMANDS
    assert [command.split()[1] for command in read_commands()] == [
        "install",
        "import",
        "check",
        "replay",
    ]
    assert "--publish --start now" in read_commands()[-1]
