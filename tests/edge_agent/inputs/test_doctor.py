"""Tests of the signal doctor (a check of recorded signals). It must name the faults that the tests
add to simulated drives, and propose corrections that remove these faults. It must accept drives
without faults and a recorded minute of real driving.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from edge_agent.cli import main
from edge_agent.inputs.doctor.diagnosis import Finding
from edge_agent.inputs.doctor.drive import prepare_drive
from edge_agent.inputs.doctor.findings import diagnose
from edge_agent.inputs.doctor.fix import apply_findings
from edge_agent.inputs.profile import Channel, Profile
from edge_agent.lab.simulation import SimulatedFleet, simulate_manoeuvre
from edge_agent.lab.simulation.friction import ICE, SNOW, WET
from edge_agent.lab.simulation.scenarios import scenario_named
from schemas.signals import CHANNELS, S
from tests.benchmarks.inputs.__main__ import main as evaluate_inputs
from tests.benchmarks.inputs.planted import (
    DELTA,
    DRIVE_S,
    PLACE,
    PLANTED,
    RATE_HZ,
    Recorded,
    doctor_verdict,
    drives,
)
from tests.edge_agent.inputs.formats import BLF, NMEA, VEHICLE
from tests.edge_agent.service import Router, Service

Output = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def rough() -> Recorded:
    """Return a simulated drive of two and a half minutes on hills, in a car with realistic sensor
    errors.
    """
    return drives(1, 23, rough=True)[0]


def draw_winter_drive(seed: int) -> Recorded:
    """Return a simulated drive through the hilly demonstration town in winter: roads that are
    usually dry are wet, usually wet roads have snow, and usually snowy roads have ice.
    """
    usual = scenario_named("hills")
    worse = {WET: SNOW, SNOW: ICE}
    patches = tuple(replace(patch, mu=worse.get(patch.mu, patch.mu)) for patch in usual.patches)
    town = replace(usual, name="winter", background=WET, patches=patches)
    fleet = SimulatedFleet(town, 1, seed, RATE_HZ, rough=0.5)
    parts = [fleet.step(round(RATE_HZ)) for _ in range(DRIVE_S)]
    t, signals = (np.concatenate([part[k] for part in parts]) for k in range(2))
    return Recorded(t[:, 0], signals[:, 0], fleet.vehicles[0])


def write(path: Path, drive: Recorded) -> list[str]:
    columns = {"t": pa.array(drive.t)}
    columns |= {
        name: pa.array(drive.signals[:, i], from_pandas=True) for i, name in enumerate(CHANNELS)
    }
    pq.write_table(pa.table(columns), path)
    path.with_suffix(".json").write_text(drive.vehicle.model_dump_json(exclude_none=True))
    return [str(path), "--vehicle", str(path.with_suffix(".json"))]


def slow_down(drive: Recorded) -> Recorded:
    """Return the drive at half its speed, which cars also reach in reverse."""
    signals = drive.signals.copy()
    signals[:, [*range(S.OMEGA, S.OMEGA + 4), S.YAW_RATE]] *= 0.5
    signals[:, [S.AX, S.AY]] *= 0.25
    return drive._replace(t=2.0 * drive.t, signals=signals)


def play_backwards(drive: Recorded) -> Recorded:
    """Return the drive played backwards: a car in reverse whose wheel speeds have no sign. Time
    reversal changes the signs of speed and yaw rate, but not of accelerations.
    """
    signals = drive.signals[::-1].copy()
    signals[:, S.YAW_RATE] *= -1.0
    return drive._replace(signals=signals)


def without(drive: Recorded, channels: list[int]) -> Recorded:
    """Return the drive without the readings of `channels`."""
    signals = drive.signals.copy()
    signals[:, channels] = np.nan
    return drive._replace(signals=signals)


def flip_ax(drive: Recorded) -> Recorded:
    """Return the drive with the wrong sign of a_x."""
    signals = drive.signals.copy()
    signals[:, S.AX] *= -1.0
    return drive._replace(signals=signals)


def list_faults(drive: Recorded) -> list[tuple[str, str]]:
    """Return channel and kind of the faults that the doctor finds, without clocks."""
    found = diagnose(drive.t, drive.signals, drive.vehicle).findings
    return [(finding.channel, finding.kind) for finding in found if finding.kind != "clock"]


@pytest.mark.parametrize("missing", [[], PLACE, [*PLACE, *DELTA]])
def test_reversing_with_unsigned_wheels_is_no_wrong_sign(
    rough: Recorded, missing: list[int]
) -> None:
    forward = slow_down(without(rough, missing))
    assert list_faults(forward) == []
    assert list_faults(play_backwards(forward)) == [("omega", "unsigned in reverse")]
    assert list_faults(flip_ax(forward)) == [("ax", "sign")]


def test_reversing_with_signed_wheel_speeds_is_no_fault(rough: Recorded) -> None:
    backwards = play_backwards(slow_down(rough))
    backwards.signals[:, S.OMEGA : S.OMEGA + 4] *= -1.0
    assert list_faults(backwards) == []


def test_straight_slow_drive_leaves_the_sign_of_a_x_open(rough: Recorded) -> None:
    """Only turns distinguish a wrong sign from a car that reverses; a fast car does not reverse."""
    straight = without(rough, [S.AY, S.YAW_RATE, *DELTA])
    assert list_faults(flip_ax(straight)) == [("ax", "sign")]
    slow = flip_ax(slow_down(straight))
    assert list_faults(slow) == []
    assert "ax" in diagnose(slow.t, slow.signals, slow.vehicle).unknown


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_mistake_is_named_and_does_not_pass(rough: Recorded, name: str) -> None:
    found, passed = doctor_verdict(PLANTED[name], rough)
    assert found
    assert not passed


@pytest.mark.parametrize("wheels", ["wheels in km/h", "wheels in rpm"])
def test_units_that_are_all_wrong_are_all_named(
    rough: Recorded, wheels: str, tmp_path: Path
) -> None:
    """A table without units has g, degrees and km/h, all at once; one correction removes all."""
    drive = rough
    for name in ("both in g", "yaw rate in deg/s", "steering wheel in deg", wheels):
        drive = PLANTED[name].spoil(drive)
    diagnosis = diagnose(*drive)
    kinds = {(finding.channel, finding.kind) for finding in diagnosis.findings}
    named = {("ax", "g"), ("ay", "g"), ("yaw_rate", "deg/s"), ("delta", "steering wheel, deg")}
    assert named | {("omega", PLANTED[wheels].kind)} <= kinds
    log = write(tmp_path / "bad.parquet", drive)
    profile = str(tmp_path / "fixed.json")
    good = str(tmp_path / "good.parquet")
    assert main(["check", *log, "--fix", profile]) == 1
    assert main(["import", log[0], "--profile", profile, *log[1:], "--out", good]) == 0
    assert main(["check", good, *log[1:]]) == 0


def test_a_sound_drive_passes_with_its_tilts_offsets_and_lags(rough: Recorded) -> None:
    diagnosis = diagnose(*rough)
    assert diagnosis.is_passed
    assert set(diagnosis.sound) == {"ax", "ay", "yaw_rate", "delta", "omega", "latitude"}


@pytest.mark.parametrize("unit", [np.pi / 180.0, 60.0])
def test_positions_in_another_unit_are_a_fault(rough: Recorded, unit: float) -> None:
    signals = rough.signals.copy()
    signals[:, S.LATITUDE : S.LONGITUDE + 1] *= unit
    diagnosis = diagnose(rough.t, signals, rough.vehicle)
    is_beyond = unit > 1.0
    kind = "range" if is_beyond else "scale"
    assert (diagnosis.findings[0].channel, diagnosis.findings[0].kind) == ("latitude", kind)
    assert len(diagnosis.findings) == 1 + is_beyond
    even = prepare_drive(*rough)
    ground = np.interp(rough.t, even.t, np.nan_to_num(even.v))
    assert diagnose(rough.t, signals, rough.vehicle, ground).findings[0].kind == kind


def test_speed_over_ground_in_another_unit_is_a_fault(rough: Recorded) -> None:
    even = prepare_drive(*rough)
    ground = 3.6 * np.interp(rough.t, even.t, np.nan_to_num(even.v))
    diagnosis = diagnose(*rough, ground)
    assert [(one.channel, one.kind) for one in diagnosis.findings] == [("gnss_speed", "scale")]


@pytest.mark.parametrize(
    ("column", "channel", "factor"),
    [
        (slice(S.DELTA, S.DELTA + 4), "delta", 57.3),
        (S.YAW_RATE, "yaw_rate", 57.3),
        (S.AY, "ay", 9.81),
    ],
)
def test_values_that_no_car_reaches_are_a_fault_in_a_short_drive(
    column: int | slice, channel: str, factor: float
) -> None:
    log, vehicle = simulate_manoeuvre("double-lane-change", mu=0.5, seed=1)
    t = log["t"].to_numpy()
    signals = np.column_stack([log[name].to_numpy().astype(float) for name in CHANNELS])
    assert diagnose(t, signals, vehicle).findings == []
    signals[:, column] *= factor
    found = diagnose(t, signals, vehicle).findings
    assert channel in {one.channel for one in found}


def test_wheels_that_send_a_constant_code_are_a_fault(rough: Recorded) -> None:
    signals = rough.signals.copy()
    signals[:, S.OMEGA] = -1.0
    signals[:, S.OMEGA + 1] = 65535.0
    diagnosis = diagnose(rough.t, signals, rough.vehicle)
    found = {(one.channel, one.kind) for one in diagnosis.findings}
    assert found == {("omega_fl", "constant"), ("omega_fr", "constant")}


def test_time_stamps_in_whole_seconds_are_a_fault(rough: Recorded) -> None:
    diagnosis = diagnose(np.floor(rough.t), rough.signals, rough.vehicle)
    assert [(one.channel, one.kind) for one in diagnosis.findings] == [("t", "repeats")]


@pytest.mark.parametrize(
    ("scale", "kind", "words"),
    [
        (1.0 / 86400.0, "days", "are these days?"),
        (30.0, "rate", "friction needs at least 5 a second"),
        (4e-4, "rate", "friction needs at most 2000 a second"),
    ],
)
def test_times_in_another_unit_are_a_fault(
    rough: Recorded, scale: float, kind: str, words: str
) -> None:
    found = diagnose(rough.t * scale, rough.signals, rough.vehicle).findings[0]
    assert (found.channel, found.kind) == ("t", kind)
    assert words in str(found)


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_log_of_a_few_rows_gives_no_finding(rough: Recorded, rows: int) -> None:
    diagnosis = diagnose(rough.t[:rows], rough.signals[:rows], rough.vehicle)
    assert not diagnosis.findings
    assert not diagnosis.is_passed
    assert not diagnosis.sound


@pytest.mark.parametrize("row", [2, 7000])
def test_a_gap_of_decades_does_not_fill_the_memory(rough: Recorded, row: int) -> None:
    t = np.where(np.arange(len(rough.t)) < row, rough.t, rough.t + 1.7e9)
    assert not diagnose(t, rough.signals, rough.vehicle).findings


def test_a_fault_of_a_channel_without_rule_is_not_corrected(rough: Recorded) -> None:
    profile = Profile(name="own", channels={"ax": Channel(signal="ax")})
    faults = [Finding("yaw", "sign", ""), Finding("t", "minutes", "", 60.0)]
    assert apply_findings(faults, profile, rough.vehicle) == (profile, rough.vehicle, faults)


def test_a_diameter_given_as_the_radius_is_named(rough: Recorded) -> None:
    radius = 2.0 * rough.vehicle.wheel_radius
    vehicle = rough.vehicle.model_copy(update={"wheel_radius": radius})
    diagnosis = diagnose(rough.t, rough.signals, vehicle)
    assert [(finding.channel, finding.kind) for finding in diagnosis.findings] == [
        ("omega", "radius")
    ]


def test_fit_removes_the_offset_from_the_samples_of_its_plot(rough: Recorded) -> None:
    fit = diagnose(*PLANTED["steering offset"].spoil(rough)).fits["steering"]
    away = fit.left - fit.gain * fit.right
    assert abs(float(np.median(away))) < 0.1 * float(fit.left.std())


def test_standing_car_gives_no_finding_and_does_not_pass(rough: Recorded) -> None:
    still = rough.signals[:3000].copy()
    still[:, : S.LATITUDE] = 0.0
    still[:, S.LATITUDE :] = np.nan
    diagnosis = diagnose(rough.t[:3000], still, rough.vehicle)
    assert not diagnosis.findings
    assert set(diagnosis.unknown) == {"ax", "ay", "yaw_rate", "delta", "omega"}
    assert not diagnosis.is_passed


@pytest.mark.parametrize(
    "name",
    ["yaw rate in deg/s", "a_y flipped", "steering late", "radius of the file", "left and right"],
)
def test_a_fix_makes_the_drive_pass(
    rough: Recorded, tmp_path: Path, name: str, capsys: Output
) -> None:
    log = write(tmp_path / "bad.parquet", PLANTED[name].spoil(rough))
    page = tmp_path / "page.html"
    profile = tmp_path / "fixed.json"
    assert main(["check", *log, "--fix", str(profile), "--out", str(page)]) == 1
    assert PLANTED[name].kind in capsys.readouterr().out
    assert page.read_text().count("<svg") >= 5
    good = str(tmp_path / "good.parquet")
    assert (
        main(["import", log[0], "--profile", str(profile), "--vehicle", log[2], "--out", good]) == 0
    )
    assert main(["check", good, *log[1:]]) == 0


def test_radius_of_a_vehicle_class_cannot_be_corrected(
    rough: Recorded, tmp_path: Path, capsys: Output, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    signals = rough.signals.copy()
    signals[:, S.OMEGA : S.OMEGA + 4] *= 1.2
    (log, *_) = write(tmp_path / "bad.parquet", rough._replace(signals=signals))
    before = set(tmp_path.iterdir())
    assert main(["check", log, "--vehicle", "class:suv", "--fix", "fixed.json"]) == 2
    assert "vehicle: class:suv is a class of vehicles, not a file" in capsys.readouterr().err
    assert set(tmp_path.iterdir()) == before


def test_fix_of_a_fault_that_no_profile_corrects_writes_nothing(
    rough: Recorded, tmp_path: Path, capsys: Output
) -> None:
    coarse = rough._replace(t=np.floor(rough.t))
    log = write(tmp_path / "bad.parquet", coarse)
    profile = tmp_path / "fixed.json"
    assert main(["check", *log, "--fix", str(profile)]) == 1
    stderr = capsys.readouterr().err
    assert "not corrected: t repeats" in stderr
    assert f"{profile}: not written" in stderr
    assert not profile.exists()


def test_a_scale_of_speeds_at_the_rim_is_corrected_in_the_profile(rough: Recorded) -> None:
    rule = Channel(signal="speed", unit="km/h")
    profile = Profile(name="own", wheel_radius=0.3, channels={"omega_fl": rule})
    faults = [Finding("omega", "radius", "", scale=0.8)]
    fixed, vehicle, left = apply_findings(faults, profile, rough.vehicle)
    assert fixed.channels["omega_fl"].scale == 0.8
    assert (fixed.wheel_radius, vehicle, left) == (0.3, rough.vehicle, [])


@pytest.mark.parametrize("option", ["--out", "--fix"])
def test_check_does_not_overwrite_its_log(
    rough: Recorded, tmp_path: Path, capsys: Output, option: str
) -> None:
    log = write(tmp_path / "bad.parquet", PLANTED["a_y flipped"].spoil(rough))
    before = Path(log[0]).read_bytes()
    assert main(["check", *log, option, log[0]]) == 2
    assert "is another file of this command" in capsys.readouterr().err
    assert Path(log[0]).read_bytes() == before


def test_check_writes_findings_as_json(rough: Recorded, tmp_path: Path, capsys: Output) -> None:
    for name, drive in (("good", rough), ("bad", PLANTED["a_y flipped"].spoil(rough))):
        log = write(tmp_path / f"{name}.parquet", drive)
        assert main(["check", *log, "--json"]) == (1 if name == "bad" else 0)
        document = json.loads(capsys.readouterr().out)
        assert document["passed"] is (name == "good")
        assert document["identities"]["lateral"]["correlation"] != 0.0
    (found,) = document["findings"]
    assert (found["channel"], found["scale"]) == ("ay", -1.0)
    assert "ay" not in document["sound"]


@pytest.mark.parametrize(
    "manoeuvre", ["slalom", "sine", "straight", "constant-radius", "acceleration", "braking"]
)
@pytest.mark.parametrize("mu", [None, 0.15])
def test_slides_and_constant_speed_accuse_no_sensor(manoeuvre: str, mu: float | None) -> None:
    log, vehicle = simulate_manoeuvre(manoeuvre, mu=mu, seed=3, duration_s=25.0)
    signals = np.stack([log[name].to_numpy(zero_copy_only=False) for name in CHANNELS], axis=1)
    assert not diagnose(log["t"].to_numpy(), signals, vehicle).findings


@pytest.fixture(scope="module")
def winter() -> Recorded:
    """Return a simulated drive of two and a half minutes on ice and snow."""
    return draw_winter_drive(23)


def test_a_drive_on_ice_and_snow_accuses_no_sensor(winter: Recorded) -> None:
    assert not diagnose(*winter).findings


@pytest.mark.parametrize(
    "name", ["yaw rate in deg/s", "a_y flipped", "steering in deg", "status bits", "wheels in mph"]
)
def test_a_mistake_is_named_on_ice_too(winter: Recorded, name: str) -> None:
    found, passed = doctor_verdict(PLANTED[name], winter)
    assert found
    assert not passed


def test_the_first_drive(tmp_path: Path, router: Router, service: Service, capsys: Output) -> None:
    """Run the commands of the tutorial `first-drive.md` on its recording, one minute of real
    driving. Every command must succeed.
    """
    log, page, out = (
        str(tmp_path / name) for name in ("drive.parquet", "check.html", "estimates.parquet")
    )
    car = ["--vehicle", str(VEHICLE)]
    config = {"zenoh": router.settings.model_dump(), "spool": str(tmp_path / "spool.sqlite")}
    (tmp_path / "agent.json").write_text(json.dumps(config))
    assert main(["import", str(BLF), str(NMEA), "--profile", "toyota", *car, "--out", log]) == 0
    assert main(["check", log, *car, "--out", page]) == 0
    publish = ["--publish", "--name", "car-one", "--config", str(tmp_path / "agent.json")]
    assert main(["replay", log, *car, "--start", "now", "--out", out, *publish]) == 0
    captured = capsys.readouterr()
    assert "passed" in captured.out
    assert captured.err.endswith("; plausible\n")
    assert json.loads(captured.out.splitlines()[-1])["observations_acknowledged"] > 50


def test_log_that_fails_the_doctor_is_published_only_with_trust(
    rough: Recorded, tmp_path: Path, router: Router, service: Service, capsys: Output
) -> None:
    bad = PLANTED["yaw rate in deg/s"].spoil(rough)
    log = write(tmp_path / "bad.parquet", bad._replace(t=bad.t[:3000], signals=bad.signals[:3000]))
    config = {"zenoh": router.settings.model_dump(), "spool": str(tmp_path / "spool.sqlite")}
    (tmp_path / "agent.json").write_text(json.dumps(config))
    send = ["--estimator", "ckf", "--name", "car-one", "--config", str(tmp_path / "agent.json")]
    replay = ["replay", *log, *send, "--publish", "--out", str(tmp_path / "out.parquet")]
    run = ["run", "--source", *log, *send, "--duration", "1"]
    for words in (replay, run):
        assert main(words) == 2
        assert capsys.readouterr().err.endswith(
            "error: log: did not pass the signal doctor; correct its profile (edge-agent check "
            "--fix), or publish it unchanged with --trust\n"
        )
    assert not service.batches
    assert main([*run, "--trust"]) == 0
    assert main([*replay, "--trust"]) in (0, 3)
    assert service.batches


def test_estimates_that_are_not_plausible_have_an_exit_code_of_their_own(
    tmp_path: Path, capsys: Output
) -> None:
    cut = drives(1, 24, rough=False, seconds=40)[0]
    good = [
        "replay",
        *write(tmp_path / "good.parquet", cut),
        "--estimator",
        "ckf",
        "--out",
        str(tmp_path / "o.parquet"),
    ]
    assert main(good) == 0
    assert "4000 samples, 40.0 s; speed" in capsys.readouterr().err
    bad = write(tmp_path / "bad.parquet", PLANTED["wheels in rpm"].spoil(cut))
    assert main(["replay", *bad, "--estimator", "ckf", "--out", str(tmp_path / "o.parquet")]) == 3
    reported = capsys.readouterr().err
    assert "NOT PLAUSIBLE" in reported
    assert f"warning: {bad[0]}: omega " in reported


@pytest.mark.campaign
def test_evaluation_of_the_inputs_writes_its_figures(tmp_path: Path) -> None:
    words = ["--quick", "--recorded", str(BLF), "--out", str(tmp_path)]
    assert evaluate_inputs(words) in (0, 1)
    figures = {
        row["name"]: row["value"] for row in json.loads((tmp_path / "figures.json").read_text())[1:]
    }
    assert figures["doctor.tries"] == 2 * len(PLANTED)
    assert figures["doctor.faults_named"] > 0.9
    assert figures["inputs.decode_errors"] == 0
    assert figures["inputs.decoded"] > 60_000, "the recorded frames are among them"
    assert figures["inputs.formats"] == 6
    assert figures["inputs.same_estimates"] <= 1e-6
    assert [figures[f"live.{kind}.samples"] for kind in ("can", "ros2", "vss")] == [100] * 3
    assert figures["live.source_loss.losses"] == 4
    assert figures["live.source_loss.crashes"] == 0
    assert "calibration.width_ratio" in figures
    assert "doctor.published_wrong" in (tmp_path / "report.md").read_text()
