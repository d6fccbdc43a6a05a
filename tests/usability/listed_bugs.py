"""Bugs that five new users found by following the documents alone, each with the tests that would
fail if the bug came back.
"""

from __future__ import annotations

import re
import subprocess
import sys
from typing import Final

from tests.structure import ROOT

_CLI: Final = "tests/edge_agent/test_cli.py::"
_FLEET_CLI: Final = "tests/fleet_service/test_cli.py::"
_PAGE: Final = "tests/fleet_service/page/"
_ANALYTICS: Final = "tests/fleet_service/analytics/"
_COMPILE: Final = "tests/fleet_service/app/test_precompile.py::"
_HOUR: Final = "tests/test_first_hour.py::"
_REASONS: Final = "tests/edge_agent/app/test_publishing_reasons.py::"

TESTS: Final[dict[str, tuple[str, ...]]] = {
    "1 doctor accuses sound steering": (
        "tests/edge_agent/inputs/test_doctor.py::test_slides_and_constant_speed_accuse_no_sensor",
    ),
    "1b replay stops without a vehicle file": (
        f"{_HOUR}test_replay_without_a_vehicle_file_explains_how_to_get_one",
    ),
    "2 steering in degrees is not named": (
        f"{_HOUR}test_real_minute_with_steering_in_degrees_is_named",
    ),
    "3 known ice is drawn as unknown": (
        "tests/test_known_ice_shown.py::test_no_output_draws_known_ice_as_unknown",
        "tests/fleet_service/serve/test_view.py::test_known_slippery_is_measured_over_all_beliefs",
    ),
    "4 pages open on an empty world": (
        f"{_ANALYTICS}test_page.py::test_cells_of_two_continents_open_as_one_area_and_a_list",
        f"{_PAGE}test_page_uses.py::test_map_of_two_continents_opens_on_one_of_them",
    ),
    "5a silent source is not named": (
        f"{_REASONS}test_a_planted_cause_is_named_within_five_seconds",
    ),
    "5b lost router is not named": (
        f"{_REASONS}test_a_reason_is_printed_again_only_when_it_changes",
    ),
    "6 breach begins before the reports": (
        f"{_ANALYTICS}roads/test_contract.py::test_a_breach_lies_within_the_measurements",
        f"{_HOUR}test_times_in_csv_answers_are_iso_8601",
    ),
    "7a page asks for an archive that it has": (
        f"{_PAGE}test_states.py::test_empty_map_states_that_no_vehicle_reported_and_what_to_do",
    ),
    "7b print shows buttons and no legend": (
        f"{_PAGE}test_page_uses.py::test_printed_page_has_map_and_text_but_no_controls",
    ),
    "7c exports of page and service differ": (
        f"{_PAGE}test_page_uses.py::test_page_exports_triangles_with_columns_of_the_service",
    ),
    "7d base map without attribution": (
        f"{_PAGE}test_basemap.py::test_attribution_of_a_base_map_is_on_the_page",
    ),
    "8a page ends while the service starts": (
        f"{_PAGE}test_page_uses.py::test_page_starts_before_the_archive_of_its_service",
    ),
    "8b examples end with IndexError": (
        f"{_HOUR}test_example_without_its_arguments_prints_its_usage",
        "tests/deploy/test_examples.py::test_the_archive_is_the_same_in_pandas_and_duckdb",
    ),
    "8c traceback without matplotlib": (
        "tests/test_commands.py::test_missing_package_is_one_line_with_its_extra",
    ),
    "8d numexpr prints its threads": (
        "tests/test_commands.py::test_no_command_reports_the_threads_of_a_library",
    ),
    "8e usage of ten lines before the reason": (f"{_HOUR}test_argument_errors_are_one_line",),
    "8f misspelt source is not named": (
        f"{_CLI}test_bad_arguments_of_other_commands_are_one_line_and_exit_code_2",
    ),
    "8g endpoint without protocol is not named": (
        f"{_FLEET_CLI}test_an_endpoint_without_a_protocol_is_named",
    ),
    "8h parameters parted by & are not named": (
        f"{_FLEET_CLI}test_parameters_parted_by_an_ampersand_are_named",
    ),
    "8i second start compiles again": (
        f"{_COMPILE}test_missing_kernels_are_compiled_once_by_a_separate_process",
    ),
    "8j title states another speed than the curve": (
        f"{_HOUR}test_title_of_the_first_estimate_has_the_speed_of_its_curve",
    ),
    "8k exit code without a router": (f"{_FLEET_CLI}test_missing_router_is_reported",),
    "8l words on a white bar": (
        f"{_PAGE}test_page_uses.py::test_unvisited_place_has_words_without_a_bar",
    ),
    "8m showing the whole map twice differs": (
        f"{_PAGE}test_page_uses.py::test_whole_map_twice_is_the_same_view",
    ),
}


def find_open() -> list[str]:
    """Run the tests of all listed bugs, and return the bugs of which a test is missing, was skipped
    or failed.
    """
    names = [name for tests in TESTS.values() for name in tests]
    command = [sys.executable, "-m", "pytest", "-rA", "-q", "--tb=no", *names]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    outcomes = re.findall(r"^(PASSED|FAILED|ERROR|SKIPPED) (\S+)", done.stdout, re.MULTILINE)
    passed = {name.partition("[")[0] for outcome, name in outcomes if outcome == "PASSED"}
    others = {name.partition("[")[0] for outcome, name in outcomes if outcome != "PASSED"}
    return [bug for bug, tests in TESTS.items() if not set(tests) <= passed - others]
