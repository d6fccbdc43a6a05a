"""Every public option is seen to matter: change it, and something that a user can see changes.

One table per place where options are declared; a test says when an option is in none of them.
"""

from __future__ import annotations

import argparse
import importlib
import json
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from edge_agent.app.estimator_factory import bank_of
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

# simulate: option -> another value than that of SIMULATED
SIMULATED = ["slalom", "--mu", "0.5", "--speed", "9", "--duration", "2", "--rate", "50", "--seed", "1"]
SIMULATE = {
    "manoeuvre": ["sine", *SIMULATED[1:]],
    **{name: [*SIMULATED, name, value] for name, value in (
        ("--mu", "0.2"), ("--speed", "11"), ("--duration", "3"), ("--rate", "100"), ("--seed", "2"),
        ("--sensors", "ideal"), ("--road", "hilly"), ("--slope", "0.03"),
    )},
    "--no-torque": [*SIMULATED, "--no-torque"],
}  # fmt: skip
LIVE, REPLAYED = "test_seed_rate_and_scenario_of_a_live_drive", "test_log_vehicle_estimator_and_configuration"
# what the other options of the commands do is told by the tests named here
REAL = "test_the_real_minute_becomes_a_log"
ELSEWHERE = {
    "simulate": {"--list": "test_simulate_lists_the_manoeuvres", "--out": "test_simulate_writes",
                 "--vehicle-out": "test_simulate_writes"},
    "import": {"source": REAL, "--profile": REAL, "--vehicle": REAL, "--out": REAL,
               "--list": "test_the_shipped_profiles",
               "--dbc": "test_another_database", "--draft": "test_another_database",
               "--clock": "test_clocks_that_do_not_meet"},
    "replay": {"log": REPLAYED, "--vehicle": REPLAYED, "--estimator": REPLAYED, "--out": REPLAYED, "--config": REPLAYED,
               "--publish": "test_replay_publishes", "--name": "test_replay_publishes",
               "--start": "test_replay_publishes", "--jobs": "test_two_jobs_write"},
    "run": {"--source": "test_run_drives_a_log", "--vehicle": "test_run_drives_a_log",
            "--name": "test_run_drives_a_log", "--config": "test_run_drives_a_log", "--estimator": REPLAYED,
            "--scenario": LIVE, "--rate": LIVE, "--seed": LIVE, "--duration": "test_fleet_gives"},
    "fleet": {"--vehicles": "test_fleet_gives", "--config": "test_fleet_gives", "--truth": "test_fleet_gives",
              "--duration": "test_fleet_gives", "--estimator": REPLAYED, "--scenario": LIVE, "--rate": LIVE,
              "--seed": LIVE, "--rough": "test_half_a_fleet_is_rough"},
    "tune": {"--seed": "test_options_out_of_range", "--ants": "test_options_out_of_range",
             "--iterations": "test_options_out_of_range", "--objective": "test_quick_tuning_writes",
             "--out": "test_quick_tuning_writes", "--quick": "test_quick_tuning_writes",
             "--study": "test_the_quick_study_writes"},
    "evaluate": {"--out": "test_the_quick_campaign", "--quick": "test_the_quick_campaign",
                 "--seeds": "test_more_seeds", "--no-plots": "test_more_seeds"},
}  # fmt: skip
# agent configuration: setting -> another value; those of sending are shown where things are sent
OBSERVED = {
    "state_rate_hz": 5.0, "slippery_mu": 1.15, "position_std": 3.0, "yaw_std": 0.1, "trip_end_m": 30.0,
    "trip_end_s": 3.0, "tyre_season": 2,
}  # fmt: skip
NUMBERS = [
    (estimator, name) for name in Vehicle.model_fields for estimator in ("aco-fckf", "compensated-wckf")
    if name not in ("name", "steering_ratio")  # which only `import` reads: test_a_measurement_file_and_a_bag
    and (estimator, name) != ("compensated-wckf", "drive_split_front")
]  # fmt: skip
SENT = {"zenoh", "spool", "spool_mb", "resend_s", "flush_s", "batch_rows", "estimator"}
WATCHED = {"metrics_port", "metrics_host", "log"}  # shown by tests/schemas/test_monitor.py


def options(command: str) -> set[str]:
    """Names of the options that a command declares."""
    parser = argparse.ArgumentParser(add_help=False)
    importlib.import_module(next(c.module for c in COMMANDS if c.name == command)).add_arguments(parser)
    return {action.option_strings[0] if action.option_strings else action.dest for action in parser._actions}


def test_every_option_of_every_command_is_in_a_table() -> None:
    for command in COMMANDS:
        shown = set(ELSEWHERE[command.name]) | (set(SIMULATE) if command.name == "simulate" else set())
        assert options(command.name) == shown, command.name


def test_the_tests_that_show_an_option_exist() -> None:
    text = "".join(path.read_text() for path in sorted(Path(__file__).parent.rglob("test_*.py")))
    for shown in ELSEWHERE.values():
        assert all(f"def {test}" in text for test in shown.values())


@pytest.mark.parametrize("option", SIMULATE)
def test_every_option_of_simulate_changes_what_is_written(option: str, tmp_path: Path) -> None:
    logs = []
    for number, arguments in enumerate((SIMULATED, SIMULATE[option])):
        path = tmp_path / f"{number}.parquet"
        assert main(["simulate", *arguments, "--out", str(path)]) == 0
        logs.append(pq.read_table(path))
    assert not logs[0].equals(logs[1])


def test_log_vehicle_estimator_and_configuration_of_a_replay_change_what_it_says(tmp_path: Path) -> None:
    for name, seed in (("one", "1"), ("other", "2")):
        files = ["--out", str(tmp_path / f"{name}.parquet"), "--vehicle-out", str(tmp_path / f"{name}.json")]
        assert main(["simulate", "slalom", "--duration", "3", "--seed", seed, *files]) == 0
    (tmp_path / "agent.json").write_text(json.dumps({"estimator": "sr-ukf"}))

    def said(log: str = "one", vehicle: str = "one", *more: str) -> FloatArray:
        out = tmp_path / "out.parquet"
        files = [str(tmp_path / f"{log}.parquet"), "--vehicle", str(tmp_path / f"{vehicle}.json"), "--out", str(out)]
        assert main(["replay", *files, *more]) == 0
        return np.asarray(pq.read_table(out)["mu"].to_numpy())

    usual, configured = said(), said("one", "one", "--config", str(tmp_path / "agent.json"))
    named = said("one", "one", "--estimator", "sr-ukf")
    for other in (said("other"), said("one", "other"), named):
        assert not np.array_equal(usual, other)
    assert np.array_equal(named, configured)


@cache
def recorded(
    scenario: str = "test", seed: int = 4, rate: float = 50.0, seconds: float = 12.0
) -> tuple[Block, SimulatedFleet]:
    """Blocks of a small fleet as one, and the fleet."""
    fleet = SimulatedFleet(scenario, vehicles=2, seed=seed, rate_hz=rate)
    source = blocks(fleet, rate)
    parts = [next(source) for _ in range(round(10 * seconds))]
    time = np.concatenate([part.t for part in parts])
    return Block(time, (time * 1e9).astype(np.int64), np.concatenate([part.signals for part in parts])), fleet


def records(config: AgentConfig) -> list[object]:
    block, fleet = recorded()
    pipeline = Pipeline(bank_of(config.estimator, fleet.vehicles), 2, config)
    _, *told = pipeline.step(block)
    return [
        [part.vehicle.tolist(), part.urgent.tolist(), *(np.nan_to_num(part.columns[n]).tolist() for n in part.columns)]
        for part in told
    ]


def test_every_setting_of_the_agent_is_in_a_table() -> None:
    assert set(AgentConfig.model_fields) == set(OBSERVED) | SENT | WATCHED


@pytest.mark.parametrize("name", OBSERVED)
def test_every_setting_of_what_is_told_changes_what_is_told(name: str) -> None:
    usual, other = AgentConfig(), AgentConfig.model_validate({name: OBSERVED[name]})
    assert getattr(usual, name) != OBSERVED[name]
    assert records(usual) != records(other)


def test_the_estimator_of_the_configuration_tells_another_friction() -> None:
    assert records(AgentConfig()) != records(AgentConfig(estimator="sr-ukf"))


@pytest.mark.parametrize(("flush_s", "rows"), [(0.2, 50), (1.0, 3)])
def test_waiting_time_and_rows_of_a_batch_change_the_batches(flush_s: float, rows: int) -> None:
    block, fleet = recorded()
    pipeline = Pipeline(bank_of("ckf", fleet.vehicles), 2, AgentConfig())
    _, _, states = pipeline.step(block)
    assert states.kind is Kind.STATE

    def batches(wait: float, most: int) -> int:
        batcher = Batcher(["car-a", "car-b"], 1, "ckf", flush_s=wait, rows=most)
        batcher.add(states, now=0.0)
        return len(batcher.due(0.5))

    assert batches(flush_s, rows) != batches(1.0, 50)


@pytest.mark.parametrize("change", [{"seed": 5}, {"rate": 100.0}, {"scenario": "demo"}], ids=lambda c: next(iter(c)))
def test_seed_rate_and_scenario_of_a_live_drive_change_it(change: dict[str, object]) -> None:
    usual = recorded(seconds=1.0)[0]
    other = recorded(seconds=1.0, **change)[0]
    assert usual.signals.shape != other.signals.shape or not np.array_equal(
        usual.signals, other.signals, equal_nan=True
    )


@pytest.mark.parametrize(("estimator", "name"), NUMBERS)
def test_every_number_of_the_vehicle_file_changes_what_is_estimated(estimator: str, name: str) -> None:
    """One fifth more of it; `name` is what a vehicle publishes under, and 002 drives every wheel by its own motor."""
    t, signals, vehicle = drive("pulses", 0.6, seconds=3.0)
    broken = signals.copy()
    broken[150:, 11:15] = np.nan  # without torque, the drive's split matters
    given = getattr(vehicle, name)
    changed = vehicle.model_copy(update={name: 1.2 * given})
    assert given is not None
    usual, other = (bank_of(estimator, [one]).advance(t[:, None], broken[:, None]) for one in (vehicle, changed))
    assert not (np.array_equal(usual.vx, other.vx) and np.array_equal(usual.mu, other.mu))
