"""Tests of the agent's command line: written files, sent messages, one-line errors."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from edge_agent.cli import COMMANDS, main
from edge_agent.estimators import ESTIMATORS
from edge_agent.lab.simulation import MANOEUVRES
from schemas import tables
from schemas.runtime import plugins
from schemas.vehicle import load_vehicle
from schemas.wire import Kind
from tests.edge_agent.fakes import BAD_LOGS
from tests.edge_agent.service import Router, Service
from tests.faults.processes import Part

COMMAND = (sys.executable, "-m", "edge_agent.cli")
Output = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with log.parquet and vehicle.json of a double lane change on a wet road."""
    folder = tmp_path_factory.mktemp("drive")
    name = next(name for name in MANOEUVRES if "lane" in name)
    arguments = ["simulate", name, "--mu", "0.5", "--speed", "15", "--duration", "8", "--seed", "3"]
    files = ["--out", str(folder / "log.parquet"), "--vehicle-out", str(folder / "vehicle.json")]
    assert main([*arguments, *files]) == 0
    return folder


def replay(drive: Path, out: Path, *more: str, log: Path | None = None) -> list[str]:
    log = log or drive / "log.parquet"
    vehicle = ["--vehicle", str(drive / "vehicle.json")]
    return ["replay", str(log), *vehicle, "--estimator", "ckf", "--out", str(out), *more]


def config(folder: Path, router: Router) -> list[str]:
    path = folder / "agent.json"
    settings = {
        "zenoh": router.settings.model_dump(),
        "spool": str(folder / "spool.sqlite"),
        "flush_s": 0.1,
    }
    path.write_text(json.dumps(settings))
    return ["--config", str(path)]


def counts(output: Output) -> dict[str, float]:
    return dict(json.loads(output.readouterr().out.splitlines()[-1]))


def test_simulate_writes_a_log_with_truth_and_the_vehicle_file(drive: Path) -> None:
    log = pq.read_table(drive / "log.parquet")
    assert log.num_rows == 800
    assert {field.name for field in tables.SIGNAL_LOG} <= set(log.column_names)
    assert {"true_vx", "true_vy", "true_mu_fl"} <= set(log.column_names)
    load_vehicle(drive / "vehicle.json")


def test_simulate_lists_the_manoeuvres(capsys: Output) -> None:
    assert main(["simulate", "--list"]) == 0
    listed = capsys.readouterr().out
    assert all(re.search(rf"^{re.escape(name)}\s+\S", listed, re.MULTILINE) for name in MANOEUVRES)
    assert main(["simulate", "--list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        name: found.about for name, found in MANOEUVRES.items()
    }


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_replay_writes_one_row_per_sample_as_the_contract_says(
    drive: Path, tmp_path: Path, estimator: str
) -> None:
    out = tmp_path / "estimates.parquet"
    arguments = replay(drive, out)
    arguments[arguments.index("ckf")] = estimator
    assert main(arguments) == 0
    estimates = pq.read_table(out)
    assert estimates.schema.equals(tables.ESTIMATES_SCHEMA)
    assert estimates["t"].equals(pq.read_table(drive / "log.parquet")["t"])
    for name in ("vx", "vy", "yaw_rate", "sideslip", "mu", "mu_lower", "mu_upper", "mu_utilised"):
        assert np.isfinite(np.array(estimates[name])).all(), name
    lower, middle, upper = (np.array(estimates[name]) for name in ("mu_lower", "mu", "mu_upper"))
    assert (lower <= middle).all()
    assert (middle <= upper).all()


def test_the_estimates_of_half_a_log_are_bit_for_bit_those_of_the_whole(
    drive: Path, tmp_path: Path
) -> None:
    log = pq.read_table(drive / "log.parquet")
    half = tmp_path / "half.parquet"
    pq.write_table(log.slice(0, 411), half)
    assert main(replay(drive, tmp_path / "whole.parquet")) == 0
    assert main(replay(drive, tmp_path / "half-out.parquet", log=half)) == 0
    whole = pq.read_table(tmp_path / "whole.parquet")
    first = pq.read_table(tmp_path / "half-out.parquet")
    assert first.num_rows == 411
    for name in whole.column_names:
        expected, found = (
            np.array(table[name].to_pylist(), dtype=float)[:411] for table in (whole, first)
        )
        assert np.array_equal(expected, found, equal_nan=True), name


def test_publishing_changes_no_estimate(
    drive: Path, tmp_path: Path, router: Router, service: Service
) -> None:
    assert main(replay(drive, tmp_path / "plain.parquet")) == 0
    assert (
        main(
            replay(
                drive, tmp_path / "sent.parquet", "--publish", "--trust", *config(tmp_path, router)
            )
        )
        == 0
    )
    assert pq.read_table(tmp_path / "plain.parquet").equals(
        pq.read_table(tmp_path / "sent.parquet")
    )


def test_replay_publishes_at_the_time_of_the_drive_and_waits(
    drive: Path, tmp_path: Path, router: Router, service: Service, capsys: Output
) -> None:
    more = [
        "--publish",
        "--trust",
        *config(tmp_path, router),
        "--name",
        "car-one",
        "--start",
        "2026-01-31T07:00:00Z",
    ]
    assert main(replay(drive, tmp_path / "out", *more)) == 0
    reported = counts(capsys)
    assert reported["unsettled"] == 0
    assert reported["published"] == reported["acknowledged"] == service.count_records() > 20
    assert {b.vehicle for b in service.batches} == {"car-one"}
    assert {b.kind for b in service.batches} == set(Kind)
    enter = np.concatenate(
        [b.columns["enter_time"] for b in service.batches if b.kind is Kind.OBSERVATION]
    )
    assert np.datetime64(int(enter.min()), "ns") == np.datetime64("2026-01-31T07:00:00")
    assert np.datetime64(int(enter.max()), "ns") < np.datetime64("2026-01-31T07:00:08")


IMPATIENT = (
    "import sys; from edge_agent.cli import main, replay; replay.DRAIN_S = .5; "
    "sys.exit(main(sys.argv[1:]))"
)


@pytest.mark.campaign
def test_replay_with_a_hanging_session_keeps_its_estimates(drive: Path, tmp_path: Path) -> None:
    """A replay must end and write its estimates although a frozen router never answers."""
    router = Part(
        "router", [sys.executable, "-m", "deploy.router", "--listen", "tcp/127.0.0.1:0"], tmp_path
    )
    router.start()
    try:
        settings = {"zenoh": {"connect": [router.line_with("router: ").split()[1]]}}
        router.freeze()
        (tmp_path / "agent.json").write_text(
            json.dumps(settings | {"spool": str(tmp_path / "spool.sqlite")})
        )
        words = replay(
            drive,
            tmp_path / "out",
            "--publish",
            "--trust",
            "--config",
            str(tmp_path / "agent.json"),
        )
        done = subprocess.run(
            [sys.executable, "-c", IMPATIENT, *words], capture_output=True, text=True, timeout=150
        )
    finally:
        router.send_signal(signal.SIGCONT)
        router.kill()
    # Messages after Zenoh has given up.
    late = ("a session did not close", "no session at tcp/127.0.0.1")
    assert any(words in done.stderr for words in late)
    assert json.loads(done.stdout)["unsettled"] > 20
    assert done.returncode == 1
    assert pq.read_table(tmp_path / "out").num_rows == pq.read_table(drive / "log.parquet").num_rows


def test_run_drives_a_log_in_real_time_and_publishes_it(
    drive: Path, tmp_path: Path, router: Router, service: Service, capsys: Output
) -> None:
    source = [
        "--source",
        str(drive / "log.parquet"),
        "--vehicle",
        str(drive / "vehicle.json"),
        "--name",
        "car-two",
    ]
    assert (
        main(
            [
                "run",
                *source,
                "--estimator",
                "ckf",
                "--duration",
                "1",
                "--trust",
                *config(tmp_path, router),
            ]
        )
        == 0
    )
    reported = counts(capsys)
    assert reported["acknowledged"] == reported["published"] == service.count_records() >= 3
    assert {b.estimator for b in service.batches} == {"ckf"}
    assert reported["unsettled"] == 0


def test_run_drives_with_the_source_of_another_distribution(
    drive: Path,
    tmp_path: Path,
    router: Router,
    service: Service,
    capsys: Output,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    about = tmp_path / "their_source-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: their-source\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[gripmap.sources]\ntheirs = their_source:blocks\n")
    (tmp_path / "their_source.py").write_text(
        "import time, pathlib\nfrom edge_agent import read_log\n"
        "blocks = lambda address: read_log(pathlib.Path(address)).blocks(time.time_ns(), 10)\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    # Bypass the cache, which an earlier test has filled.
    monkeypatch.setattr(plugins, "entry_points_of", plugins.entry_points_of.__wrapped__)
    source = [
        "--source",
        f"theirs:{drive / 'log.parquet'}",
        "--vehicle",
        str(drive / "vehicle.json"),
    ]
    words = ["run", *source, "--estimator", "ckf", "--duration", "1", *config(tmp_path, router)]
    assert main([*words, "--name", "car-three"]) == 0
    reported = counts(capsys)
    assert reported["acknowledged"] == reported["published"] == service.count_records() >= 3
    assert main([*words[:2], "no-such:address", *words[3:]]) == 2
    assert "source: 'no-such:address' is not a file, and 'no-such' is not a kind of source" in (
        line := capsys.readouterr().err
    )
    assert "kinds are can, gpsd, ros2, simulated, theirs, vss" in line


def test_fleet_gives_each_vehicle_its_name_and_writes_what_is_true(
    tmp_path: Path, router: Router, service: Service, capsys: Output
) -> None:
    truth = tmp_path / "truth.parquet"
    options = [
        "--vehicles",
        "4",
        "--scenario",
        "demo",
        "--rate",
        "50",
        "--seed",
        "2",
        "--truth",
        str(truth),
    ]
    assert (
        main(
            ["fleet", *options, "--estimator", "ckf", "--duration", "2", *config(tmp_path, router)]
        )
        == 0
    )
    names = {f"sim-{n:03}" for n in range(1, 5)}
    assert (
        {b.vehicle for b in service.batches}
        == names
        == set(pq.read_table(truth)["vehicle"].to_pylist())
    )
    assert {b.estimator for b in service.batches} == {"ckf"}
    reported = counts(capsys)
    assert reported["unsettled"] == reported["observations_unsettled"] == 0
    assert reported["observations_published"] >= 4


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT], ids=["SIGTERM", "Ctrl-C"])
def test_signalled_agent_sends_its_records_and_waits_for_the_answer(
    tmp_path: Path, router: Router, service: Service, number: signal.Signals
) -> None:
    options = ["run", "--source", "simulated", "--estimator", "ckf", *config(tmp_path, router)]
    with subprocess.Popen([*COMMAND, *options], stdout=subprocess.PIPE, text=True) as agent:
        service.wait(lambda batches: len(batches) >= 2)
        agent.send_signal(number)
        out, _ = agent.communicate(timeout=60)
    assert agent.returncode == 0
    reported = json.loads(out.splitlines()[-1])
    assert reported["unsettled"] == 0
    assert reported["published"] == service.count_records()
    assert reported["observations_published"] >= 1


@pytest.mark.campaign
def test_batches_stored_by_a_killed_agent_are_sent_by_the_next(
    tmp_path: Path, router: Router, service: Service, capsys: Output
) -> None:
    service.answer = False
    options = ["run", "--source", "simulated", "--estimator", "ckf", *config(tmp_path, router)]
    with subprocess.Popen([*COMMAND, *options], stdout=subprocess.DEVNULL) as agent:
        service.wait(lambda batches: len(batches) >= 4)
        agent.kill()
    earlier = set(service.identities())
    service.answer = True
    service.batches.clear()
    assert main([*options, "--duration", "0.5"]) == 0
    seen = capsys.readouterr()
    assert "driving; a line of counts every 5 s" in seen.err, (
        "the first of them comes after five seconds"
    )
    assert json.loads(seen.out.splitlines()[-1])["unsettled"] == 0
    assert earlier <= set(service.identities())


BAD_ARGUMENTS = {
    "unknown estimator": (
        ["--estimator", "oracle"],
        "^error: estimator: 'oracle' is unknown; .*aco-fckf.*ckf",
    ),
    "no vehicle file": (["--vehicle", "nowhere.json"], "^error: vehicle: cannot read nowhere.json"),
    "broken start": (
        ["--start", "yesterday"],
        "^error: start: 'yesterday' is not a time; write it like 2026",
    ),
    "no configuration": (["--config", "nowhere.json"], "^error: config: cannot read nowhere.json"),
    "name for no key": (
        ["--publish", "--name", "My Car/**"],
        "^error: name: 'My Car/\\*\\*' is not a vehicle name; give",
    ),
    "folder that is none": (["--out", "/dev/null/out"], "^error: out: cannot write /dev/null/out"),
}


@pytest.mark.parametrize(("more", "message"), BAD_ARGUMENTS.values(), ids=BAD_ARGUMENTS)
def test_a_bad_argument_of_replay_is_one_line_and_exit_code_2(
    drive: Path, tmp_path: Path, capsys: Output, more: list[str], message: str
) -> None:
    assert main(replay(drive, tmp_path / "out", *more)) == 2
    _one_error(capsys, message)
    assert not list(tmp_path.iterdir())


def test_run_checks_the_name_before_it_opens_the_source(capsys: Output) -> None:
    assert main(["run", "--source", "nowhere.parquet", "--name", "My Car"]) == 2
    _one_error(capsys, "^error: name: 'My Car' is not a vehicle name; give")


@pytest.mark.parametrize(("spoil", "message"), BAD_LOGS.values(), ids=BAD_LOGS)
def test_bad_log_gives_one_line_and_exit_code_2_without_output(
    drive: Path, tmp_path: Path, capsys: Output, spoil: Callable[[Path], None], message: str
) -> None:
    spoil(tmp_path / "log")
    assert main(replay(drive, tmp_path / "out", log=tmp_path / "log")) == 2
    _one_error(capsys, message.replace("^", "^error: "))
    assert not (tmp_path / "out").exists()


BAD_VEHICLES = {
    "negative mass": (
        {"mass": -1500.0},
        "^error: mass: .*greater than 0 .*; correct it in the vehicle file",
    ),
    "no mass": ({"mass": None}, "^error: mass: "),
    "mass in tonnes": ({"mass": 1.643}, "^error: mass: 1.643 .* of gyration of 3.* m; give kg"),
    "stiffness in kN": ({"cornering_stiffness": 64.8}, "^error: cornering_stiffness: 64.8 is less"),
    "text": ({"wheel_radius": "big"}, "^error: wheel_radius: "),
}


@pytest.mark.parametrize(("change", "message"), BAD_VEHICLES.values(), ids=BAD_VEHICLES)
def test_a_bad_vehicle_file_is_one_line_and_exit_code_2(
    drive: Path, tmp_path: Path, capsys: Output, change: dict[str, object], message: str
) -> None:
    vehicle = json.loads((drive / "vehicle.json").read_text()) | change
    (tmp_path / "bad.json").write_text(json.dumps(vehicle))
    assert main(replay(drive, tmp_path / "out", "--vehicle", str(tmp_path / "bad.json"))) == 2
    _one_error(capsys, message)


BAD_COMMANDS = {
    "no manoeuvre": (["simulate"], "^error: manoeuvre: is not given; name one"),
    "unknown manoeuvre": (["simulate", "moonwalk", "--out", "x"], "^error: manoeuvre: "),
    "no output": (["simulate", next(iter(MANOEUVRES))], "^error: out: is not given; "),
    "no vehicles": (["fleet", "--vehicles", "0"], "^error: vehicles: "),
    "too many vehicles": (["fleet", "--vehicles", "1000"], "^error: vehicles: .* from 1 to 999"),
    "unknown scenario": (["fleet", "--scenario", "moon"], "^error: scenario: "),
    "truth into nowhere": (
        ["fleet", "--truth", "/dev/null/truth"],
        "^error: truth: cannot write /dev/null/truth",
    ),
    "log without vehicle": (["run", "--source", __file__], "^error: vehicle: is not given; "),
    "misspelt source": (
        ["run", "--source", "simulted", "--name", "car-x"],
        "^error: source: 'simulted' is not a file",
    ),
}


@pytest.mark.parametrize(("arguments", "message"), BAD_COMMANDS.values(), ids=BAD_COMMANDS)
def test_bad_arguments_of_other_commands_are_one_line_and_exit_code_2(
    capsys: Output, arguments: list[str], message: str
) -> None:
    assert main(arguments) == 2
    _one_error(capsys, message)


def _one_error(capsys: Output, message: str) -> None:
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert re.search(message, lines[0]), lines[0]
    assert "; " in lines[0]


def test_a_setting_that_zenoh_refuses_is_named(drive: Path, tmp_path: Path, capsys: Output) -> None:
    (tmp_path / "agent.json").write_text('{"zenoh": {"config": {"connect/retri": 1}}}')
    options = [
        "--publish",
        "--trust",
        "--config",
        str(tmp_path / "agent.json"),
        "--name",
        "car-one",
    ]
    assert main(replay(drive, tmp_path / "out", *options)) == 2
    _one_error(capsys, "^error: zenoh.config.connect/retri: ")


def test_an_outbox_in_use_is_refused(
    drive: Path, tmp_path: Path, router: Router, capsys: Output
) -> None:
    from edge_agent.publish.outbox import Outbox

    options = ["--publish", "--trust", *config(tmp_path, router), "--name", "car-one"]
    outbox = Outbox(tmp_path / "spool.sqlite")
    assert main(replay(drive, tmp_path / "out", *options)) == 2
    outbox.close()
    _one_error(capsys, "^error: spool: .* is used by another agent; give each agent its own")


@pytest.mark.parametrize("name", [command.name for command in COMMANDS])
def test_every_command_explains_itself(name: str, capsys: Output) -> None:
    with pytest.raises(SystemExit, match="0"):
        main([name, "--help"])
    assert "options:" in capsys.readouterr().out


def test_help_imports_nothing_heavy() -> None:
    script = (
        "import sys; from edge_agent.cli import main\ntry: main(['--help'])\nexcept "
        "SystemExit: pass\n"
    )
    heavy = (
        "print([m for m in ('numba', 'numpy', 'pyarrow', 'zenoh', 'pydantic') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script + heavy], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "[]"


def test_estimates_of_a_split_or_odd_log_stay_finite(drive: Path, tmp_path: Path) -> None:
    """A log has no torques and no rear steering angles. Every second reading of the front left
    wheel speed is missing. All estimates must be finite, and some must have a health flag.
    """
    log = pq.read_table(drive / "log.parquet")
    gone = [n for n in log.column_names if n.startswith(("torque", "delta_r", "true"))]
    holes = pa.array(
        np.where(np.arange(log.num_rows) % 2, np.nan, np.array(log["omega_fl"], dtype=float))
    )
    index = log.column_names.index("omega_fl")
    pq.write_table(log.set_column(index, "omega_fl", holes).drop_columns(gone), tmp_path / "log")
    assert main(replay(drive, tmp_path / "out", log=tmp_path / "log")) == 0
    estimates = pq.read_table(tmp_path / "out")
    assert np.isfinite(np.array(estimates["mu"])).all()
    assert np.array(estimates["health"]).any()
