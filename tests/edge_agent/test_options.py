"""Tests that every public option has a visible effect: if it is changed, some output changes.

One table per module lists the module's options. A test fails if an option is in no table.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from edge_agent.app.agent import Agent
from edge_agent.app.estimator_factory import bank_of
from edge_agent.app.tuned_memberships import FOLDER
from edge_agent.cli import COMMANDS, main
from edge_agent.inputs.block import Block
from edge_agent.lab.simulation import SimulatedFleet
from edge_agent.lab.simulation.blocks import blocks
from edge_agent.observe.pipeline import Pipeline
from edge_agent.publish.batching import Batcher
from schemas.config import AgentConfig
from schemas.numeric import FloatArray
from schemas.vehicle import Vehicle
from schemas.wire import Kind
from tests.edge_agent.estimators.drives import drive

# Options of `simulate`: a command line with another value than in SIMULATED.
SIMULATED = [
    "slalom",
    "--mu",
    "0.5",
    "--speed",
    "9",
    "--duration",
    "2",
    "--rate",
    "50",
    "--seed",
    "1",
]
SIMULATE = {
    "manoeuvre": ["sine", *SIMULATED[1:]],
    **{
        name: [*SIMULATED, name, value]
        for name, value in (
            ("--mu", "0.2"),
            ("--speed", "11"),
            ("--duration", "3"),
            ("--rate", "100"),
            ("--seed", "2"),
            ("--sensors", "ideal"),
            ("--road", "hilly"),
            ("--slope", "0.03"),
        )
    },
    "--no-torque": [*SIMULATED, "--no-torque"],
}
# Options of `run`, `fleet` and `tune`: the words that are added to those of USUAL. `{0}` and `{1}`
# are two recorded drives.
USUAL = {
    "run": ["run"],
    "fleet": ["fleet", "--vehicles", "3"],
    "tune": ["tune", "--quick"],
}
LOGGED = ["--source", "{0}.parquet", "--vehicle", "{0}.json", "--trust"]
CHANGED: dict[tuple[str, str], list[str]] = {
    ("run", "--source"): LOGGED,
    ("run", "--vehicle"): ["--vehicle", "{1}.json"],
    **{
        (command, option): [option, value]
        for command in ("run", "fleet")
        for option, value in (
            ("--memberships", "{0}.memberships"),
            ("--estimator", "ckf"),
            ("--config", "{0}.agent"),
            ("--scenario", "hills"),
            ("--rate", "50"),
            ("--seed", "1"),
            ("--duration", "7"),
        )
    },
    ("run", "--name"): ["--name", "car-one"],
    ("fleet", "--vehicles"): ["--vehicles", "4"],
    ("fleet", "--rough"): ["--rough", "0.5"],
    ("fleet", "--truth"): ["--truth", "{0}.truth"],
    **{
        ("tune", option): [option, value]
        for option, value in (
            ("--seed", "14"),
            ("--ants", "4"),
            ("--iterations", "3"),
            ("--objective", "innovation"),
            ("--out", "{0}.tuned"),
            ("--repeats", "2"),
        )
    },
}
REPLAYED = "test_replay_depends_on_log_vehicle_estimator_and_configuration"
SENT_BY_REPLAY = "test_replay_publishes_at_the_time_of_the_drive_and_waits"
# Tests in other modules that show the effect of the remaining options.
REAL = "test_the_real_minute_becomes_a_log_in_si_with_its_provenance"
CAMPAIGN = "test_the_quick_campaign_writes_figures_report_and_plots"
SEEDS = "test_options_add_seeds_and_omit_plots"
UNFIT = "test_log_that_fails_the_doctor_is_published_only_with_trust"
LEARNED = "test_a_calibrated_file_is_written_read_and_heeded"
LIVE = "test_a_live_car_is_driven_by_its_bus_and_its_receiver"
PLANNER = "test_limits_for_a_planner_without_listening_are_a_mistake"
LISTENS = "test_a_car_that_listens_prints_its_warnings_and_heeds_its_route"
FIX = "test_a_fix_makes_the_drive_pass"
CONNECT = "test_connect_replaces_the_router_and_unsent_records_are_reported"
ELSEWHERE = {
    "simulate": {
        "--list": "test_simulate_lists_the_manoeuvres",
        "--json": "test_simulate_lists_the_manoeuvres",
        "--out": "test_simulate_writes_a_log_with_truth_and_the_vehicle_file",
        "--vehicle-out": "test_simulate_writes_a_log_with_truth_and_the_vehicle_file",
    },
    "import": {
        "source": REAL,
        "--profile": REAL,
        "--vehicle": REAL,
        "--out": REAL,
        "--list": "test_the_shipped_profiles_are_listed",
        "--json": "test_the_shipped_profiles_are_listed",
        "--dbc": "test_another_database_and_a_named_draft",
        "--draft": "test_another_database_and_a_named_draft",
        "--clock": "test_clocks_that_do_not_meet_are_an_error_with_its_remedy",
    },
    "replay": {
        "log": REPLAYED,
        "--vehicle": REPLAYED,
        "--estimator": REPLAYED,
        "--out": REPLAYED,
        "--config": REPLAYED,
        "--connect": CONNECT,
        "--publish": SENT_BY_REPLAY,
        "--trust": UNFIT,
        "--name": SENT_BY_REPLAY,
        "--start": SENT_BY_REPLAY,
        "--compare": "test_report_contains_the_compared_estimators",
        "--jobs": "test_so_many_drives_are_under_way_at_once",
        "--engine": "test_spark_engine_needs_several_logs_and_refuses_jobs",
        "--memberships": "test_tuned_memberships_change_the_estimates_of_replay",
    },
    "check": {
        "log": FIX,
        "--vehicle": FIX,
        "--out": FIX,
        "--fix": FIX,
        "--json": "test_check_writes_findings_as_json",
    },
    "calibrate": {"log": LEARNED, "--vehicle": LEARNED, "--out": LEARNED, "--trust": LEARNED},
    "run": {
        "--connect": CONNECT,
        "--trust": UNFIT,
        "--profile": LIVE,
        "--dbc": LIVE,
        "--ahead": LISTENS,
        "--route": LISTENS,
        "--autoware": PLANNER,
        "--autoware-hash": PLANNER,
        "--vss": "test_the_command_prints_lines_of_the_drive",
        "--kuksa": "test_command_writes_the_friction_to_the_databroker",
    },
    "fleet": {
        "--connect": CONNECT,
        "--warned": "test_only_the_given_share_of_a_fleet_is_warned",
        "--winter": "test_a_share_of_winter_vehicles_beyond_one_is_refused",
    },
    "completion": {"shell": "test_completion_is_a_script_of_the_shell"},
    "tune": {
        "log": "test_tuning_can_use_the_users_own_drives",
        "--vehicle": "test_tuning_can_use_the_users_own_drives",
        "--quick": "test_quick_tuning_writes_a_valid_file_and_reports_its_progress",
        "--study": "test_the_quick_study_writes_figures_table_plot_and_a_tuned_file",
    },
    "evaluate": {
        "--out": CAMPAIGN,
        "--quick": CAMPAIGN,
        "--seeds": SEEDS,
        "--no-plots": SEEDS,
        "--plots": CAMPAIGN,
        "--logs": "test_logs_of_a_folder_are_judged_and_reported",
        "--only": "test_logs_of_a_folder_are_judged_and_reported",
        "--paper": "test_paper_is_reproduced_and_written",
    },
}
# Settings of the agent that influence observations, with another value. SENT lists the settings of
# the connection.
OBSERVED = {
    "state_rate_hz": 5.0,
    "slippery_mu": 1.15,
    "position_std": 3.0,
    "yaw_std": 0.1,
    "trip_end_m": 30.0,
    "trip_end_s": 3.0,
    "tyre_season": 2,
}
# Vehicle fields without a default value. Other tests cover them: inputs/test_adopt.py for
# corrections, schemas/test_vehicle_axles.py for the prior.
OPTIONAL = {
    "wheel_radius_front",
    "wheel_radius_rear",
    "cornering_stiffness_front",
    "cornering_stiffness_rear",
    "steering_compliance",
    "rear_axle_locked",
}
NUMBERS = [
    (estimator, name)
    for name in Vehicle.model_fields
    for estimator in ("aco-fckf", "compensated-wckf")
    if name
    # `import` and the log readers use these fields; test_learn covers them.
    not in (
        "name",
        "steering_ratio",
        "calibration",
    )
    and name not in OPTIONAL
    and (estimator, name) != ("compensated-wckf", "drive_split_front")
]
SENT = {"zenoh", "spool", "spool_mb", "resend_s", "flush_s", "batch_rows", "estimator"}
# Settings that tests/schemas/test_monitor.py covers.
WATCHED = {"metrics_port", "metrics_host", "log"}


def options(command: str) -> set[str]:
    """Return the names of the options that a command declares."""
    parser = argparse.ArgumentParser(add_help=False)
    importlib.import_module(next(c.module for c in COMMANDS if c.name == command)).add_arguments(
        parser
    )
    return {
        action.option_strings[0] if action.option_strings else action.dest
        for action in parser._actions
    }


def test_every_option_of_every_command_is_in_a_table() -> None:
    for command in COMMANDS:
        shown = set(ELSEWHERE[command.name]) | {
            option for name, option in CHANGED if name == command.name
        }
        assert options(command.name) == shown | (
            set(SIMULATE) if command.name == "simulate" else set()
        ), command.name


def test_the_tests_that_show_an_option_give_it_to_the_command() -> None:
    """The tables name, for some options, a test in another module that shows the effect. The source
    of each named test must contain its option.
    """
    texts = [
        path.read_text()
        for path in sorted(Path(__file__).parent.rglob("test_*.py"))
        if path != Path(__file__)
    ]
    texts += [
        (Path(__file__).parents[1] / f"test_{name}.py").read_text()
        for name in ("commands", "faces")
    ]
    # Only the code below the tables counts.
    texts.append(Path(__file__).read_text().partition("def options(")[2])
    for command, shown in ELSEWHERE.items():
        for option, test in shown.items():
            text = "".join(text for text in texts if f"def {test}" in text)
            assert f'"{option}"' in text or (text and not option.startswith("-")), (command, option)


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with input files: two drives, their vehicle files, a file of memberships
    (parameters of fuzzy sets) and a configuration file.
    """
    folder = tmp_path_factory.mktemp("given")
    for k in (0, 1):
        files = ["--out", str(folder / f"{k}.parquet"), "--vehicle-out", str(folder / f"{k}.json")]
        assert main(["simulate", "slalom", "--duration", "2", "--seed", str(k), *files]) == 0
    shutil.copy(FOLDER / "paper-aco-fckf.json", folder / "0.memberships")
    (folder / "0.agent").write_text(json.dumps({"estimator": "sr-ukf", "batch_rows": 7}))
    return folder


def record_arguments(words: list[str], monkeypatch: pytest.MonkeyPatch, folder: Path) -> object:
    """Run a live command with a stub in place of its main loop. Return the arguments that the stub
    received: vehicles, names, signals, settings, estimator, duration, and files.
    """
    seen: list[object] = []

    def note(agent: Agent) -> int:
        assert not agent.parts
        first = [next(agent.source.blocks) for _ in range(3)]
        agent.source.end()
        signals = [(block.t.tolist(), np.nan_to_num(block.signals).tolist()) for block in first]
        options = agent.options
        seen.append(
            [
                list(options.vehicles),
                list(options.names),
                signals,
                options.config,
                options.estimator,
                options.memberships,
                options.duration_s,
            ]
        )
        return 0

    monkeypatch.setattr(Agent, "drive", note)
    assert main(words) == 0
    return seen, sorted(path.name for path in folder.iterdir())


@pytest.mark.campaign
@pytest.mark.parametrize(("command", "option"), [pair for pair in CHANGED if pair[0] != "tune"])
def test_every_option_of_a_live_command_changes_what_is_driven(
    command: str, option: str, given: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "given"
    shutil.copytree(given, folder)
    changed = [word.format(folder / "0", folder / "1") for word in CHANGED[command, option]]
    usual = USUAL[command]
    if option == "--vehicle":
        usual = [*usual, *(word.format(folder / "0", folder / "1") for word in LOGGED)]
    first, again, other = (
        record_arguments(words, monkeypatch, folder) for words in (usual, usual, [*usual, *changed])
    )
    assert first == again
    assert other != first


@cache
def run_search(folder: Path, *words: str) -> tuple[object, list[str]]:
    """Run a quick search for good memberships (parameters of fuzzy sets). Return its result
    (memberships, scores and budget) and the names of the files that it wrote.
    """
    folder.mkdir(parents=True)
    with contextlib.chdir(folder):
        assert main([*USUAL["tune"], *words]) == 0
    (path,) = folder.iterdir()
    document = json.loads(path.read_text())
    found = {name: part for name, part in document.items() if name != "provenance"}
    return found | {"budget": document["provenance"]["budget"]}, [path.name]


@pytest.mark.campaign
@pytest.mark.parametrize("option", [option for command, option in CHANGED if command == "tune"])
def test_every_option_of_tune_changes_what_is_found(
    option: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    base = tmp_path_factory.getbasetemp() / "tuned"
    words = [word.format("0") for word in CHANGED["tune", option]]
    assert run_search(base / "usual") != run_search(base / option, *words)


@pytest.mark.parametrize("option", SIMULATE)
def test_every_option_of_simulate_changes_what_is_written(option: str, tmp_path: Path) -> None:
    logs = []
    for number, arguments in enumerate((SIMULATED, SIMULATE[option])):
        path = tmp_path / f"{number}.parquet"
        assert main(["simulate", *arguments, "--out", str(path)]) == 0
        logs.append(pq.read_table(path))
    assert not logs[0].equals(logs[1])


def test_replay_depends_on_log_vehicle_estimator_and_configuration(tmp_path: Path) -> None:
    for name, seed in (("one", "1"), ("other", "2")):
        files = [
            "--out",
            str(tmp_path / f"{name}.parquet"),
            "--vehicle-out",
            str(tmp_path / f"{name}.json"),
        ]
        assert main(["simulate", "slalom", "--duration", "3", "--seed", seed, *files]) == 0
    (tmp_path / "agent.json").write_text(json.dumps({"estimator": "sr-ukf"}))

    def replay_estimates(log: str = "one", vehicle: str = "one", *more: str) -> FloatArray:
        out = tmp_path / "out.parquet"
        files = [
            str(tmp_path / f"{log}.parquet"),
            "--vehicle",
            str(tmp_path / f"{vehicle}.json"),
            "--out",
            str(out),
        ]
        assert main(["replay", *files, *more]) == 0
        return np.asarray(pq.read_table(out)["mu"].to_numpy())

    usual = replay_estimates()
    configured = replay_estimates("one", "one", "--config", str(tmp_path / "agent.json"))
    named = replay_estimates("one", "one", "--estimator", "sr-ukf")
    for other in (replay_estimates("other"), replay_estimates("one", "other"), named):
        assert not np.array_equal(usual, other)
    assert np.array_equal(named, configured)


@cache
def record_blocks(
    scenario: str = "test", seed: int = 4, rate: float = 50.0, seconds: float = 12.0
) -> tuple[Block, SimulatedFleet]:
    """Simulate a small fleet for `seconds`. Return its blocks of samples, joined into one block,
    and the simulated fleet.
    """
    fleet = SimulatedFleet(scenario, vehicles=2, seed=seed, rate_hz=rate)
    source = blocks(fleet, rate)
    parts = [next(source) for _ in range(round(10 * seconds))]
    time = np.concatenate([part.t for part in parts])
    return Block(
        time, (time * 1e9).astype(np.int64), np.concatenate([part.signals for part in parts])
    ), fleet


def records(config: AgentConfig) -> list[object]:
    block, fleet = record_blocks()
    pipeline = Pipeline(bank_of(config.estimator, fleet.vehicles), 2, config)
    _, *output = pipeline.step(block)
    return [
        [
            part.vehicle.tolist(),
            part.urgent.tolist(),
            *(np.nan_to_num(part.columns[n]).tolist() for n in part.columns),
        ]
        for part in output
    ]


def test_every_setting_of_the_agent_is_in_a_table() -> None:
    assert set(AgentConfig.model_fields) == set(OBSERVED) | SENT | WATCHED


@pytest.mark.parametrize("name", OBSERVED)
def test_every_setting_of_observations_changes_the_records(name: str) -> None:
    usual = AgentConfig()
    other = AgentConfig.model_validate({name: OBSERVED[name]})
    assert getattr(usual, name) != OBSERVED[name]
    assert records(usual) != records(other)


def test_configured_estimator_changes_the_friction() -> None:
    assert records(AgentConfig()) != records(AgentConfig(estimator="sr-ukf"))


@pytest.mark.parametrize(("flush_s", "rows"), [(0.2, 50), (1.0, 3)])
def test_waiting_time_and_rows_of_a_batch_change_the_batches(flush_s: float, rows: int) -> None:
    block, fleet = record_blocks()
    pipeline = Pipeline(bank_of("ckf", fleet.vehicles), 2, AgentConfig())
    _, _, states = pipeline.step(block)
    assert states.kind is Kind.STATE

    def batches(wait: float, most: int) -> int:
        batcher = Batcher(["car-a", "car-b"], 1, "ckf", flush_s=wait, rows=most)
        batcher.add(states, now=0.0)
        return len(batcher.take_due(0.5))

    assert batches(flush_s, rows) != batches(1.0, 50)


@pytest.mark.parametrize(("estimator", "name"), NUMBERS)
def test_every_number_of_the_vehicle_file_changes_what_is_estimated(
    estimator: str, name: str
) -> None:
    """The estimates must change if the number `name` in the vehicle file is increased by a
    fifth.
    """
    t, signals, vehicle = drive("pulses", 0.6, seconds=3.0)
    broken = signals.copy()
    broken[150:, 11:15] = np.nan  # without torque readings the drive split matters
    given = getattr(vehicle, name)
    changed = vehicle.model_copy(update={name: 1.2 * given})
    assert given is not None
    usual, other = (
        bank_of(estimator, [one]).advance(t[:, None], broken[:, None]) for one in (vehicle, changed)
    )
    assert not (np.array_equal(usual.vx, other.vx) and np.array_equal(usual.mu, other.mu))
