"""Tests of the public interfaces. Every name must exist, be documented and be importable; plug-ins
of other distributions must be found.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import edge_agent
import fleet_service
import gripmap
from edge_agent.cli import main
from schemas.errors import InputError
from schemas.tables import ESTIMATES_SCHEMA
from tests.structure import ROOT

FACES = (edge_agent, fleet_service)


@pytest.mark.parametrize("face", FACES, ids=lambda face: str(face.__name__))
def test_every_public_name_exists_and_is_documented(face: object) -> None:
    names = face.__all__  # type: ignore[attr-defined]
    assert list(names) == sorted(names)
    assert len(names) >= 8
    for name in names:
        found = getattr(face, name)
        assert isinstance(found, (dict, tuple)) or (found.__doc__ or "").strip(), name
        assert getattr(gripmap, name) is found
    with pytest.raises(AttributeError, match="its public names are"):
        _ = face.no_such_name  # type: ignore[attr-defined]
    assert set(names) <= set(dir(gripmap))
    folder = Path(str(face.__file__)).parent  # type: ignore[attr-defined]
    assert not [name for name in names if (folder / name).exists()], (
        "a room of that name would hide it once imported"
    )


def test_importing_a_public_package_loads_no_heavy_library() -> None:
    heavy = ("numba", "numpy", "pyarrow", "zenoh")
    words = (
        f"import sys, edge_agent, fleet_service; print([name for name in {heavy} if name in "
        "sys.modules])"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", words], capture_output=True, text=True, check=True
        ).stdout
        == "[]\n"
    )


@pytest.mark.parametrize("face", ["gripmap", "edge_agent.estimators", "fleet_service.client"])
def test_foreign_package_that_hides_ours_is_named(tmp_path: Path, face: str) -> None:
    own = tmp_path / "schemas" / "__init__.py"
    own.parent.mkdir()
    own.touch()
    done = subprocess.run(
        [sys.executable, "-c", f"import {face}"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"ImportError: schemas: {own} stands where"), done.stderr
    assert "rename it" in last


def test_a_log_is_estimated_in_three_lines_as_the_command_does(tmp_path: Path) -> None:
    log = tmp_path / "x.parquet"
    car = tmp_path / "x.json"
    assert (
        main(
            ["simulate", "slalom", "--duration", "2", "--out", str(log), "--vehicle-out", str(car)]
        )
        == 0
    )
    assert main(
        ["replay", str(log), "--out", str(tmp_path / "e.parquet"), "--estimator", "ckf"]
    ) in (0, 3)
    found = edge_agent.estimate(
        edge_agent.read_log(str(log)), edge_agent.load_vehicle(str(car)), "ckf"
    )
    assert found.schema.equals(ESTIMATES_SCHEMA)
    assert found.equals(pq.read_table(tmp_path / "e.parquet"))


def test_estimates_of_one_of_many_vehicles_become_a_table() -> None:
    log, vehicle = edge_agent.simulate_manoeuvre("slalom", duration_s=0.5)
    signals = np.stack([log[name].to_numpy() for name in edge_agent.CHANNELS], axis=-1)[
        :, None
    ].repeat(2, axis=1)
    t = log["t"].to_numpy()[:, None].repeat(2, axis=1)
    bank = edge_agent.make_bank("ckf", [vehicle, vehicle])
    found = bank.advance(t, signals)
    assert edge_agent.to_table(t, found, 1).equals(edge_agent.to_table(t[:, 0], found))
    with pytest.raises(InputError, match="vehicle: 2 is not one of the 2 vehicles"):
        edge_agent.to_table(t, found, 2)


def test_tuned_memberships_change_the_estimates_of_replay(tmp_path: Path) -> None:
    from edge_agent.app.tuned_memberships import FOLDER

    document = json.loads((FOLDER / "paper-aco-fckf.json").read_text())
    document["memberships"] = edge_agent.Memberships().to_json()
    (tmp_path / "mine.json").write_text(json.dumps(document))
    log = tmp_path / "x.parquet"
    car = tmp_path / "x.json"
    assert (
        main(
            ["simulate", "slalom", "--duration", "2", "--out", str(log), "--vehicle-out", str(car)]
        )
        == 0
    )
    estimates = []
    for more in ([], ["--memberships", str(tmp_path / "mine.json")]):
        words = [
            "replay",
            str(log),
            "--estimator",
            "paper-aco-fckf",
            "--out",
            str(tmp_path / "e.parquet"),
            *more,
        ]
        assert main(words) in (0, 3)
        estimates.append(pq.read_table(tmp_path / "e.parquet")["adaptation"])
    assert not estimates[0].equals(estimates[1])
    assert (
        main([*words[:2], "--out", str(tmp_path / "e.parquet"), "--estimator", "sr-ukf", *more])
        == 2
    )


PLUGIN = """
import numpy as np
import pyarrow as pa
from deploy.examples.own_estimator import AtLeast
from fleet_service import Question

bank = AtLeast


def blocks(address):
    import edge_agent
    log, _ = edge_agent.simulate_manoeuvre("slalom", duration_s=float(address))
    signals = np.stack([log[name].to_numpy() for name in edge_agent.CHANNELS], axis=-1)
    for block in edge_agent.SignalLog(log["t"].to_numpy(), signals, None).blocks(0, 10):
        yield block


def brush(theta):
    left = np.maximum(1.0 - theta / 3.0, 0.0)
    return 1.0 - left**3


def steep(theta):
    return np.minimum(2.0 * theta, 1.0)


def count_rows(engine, options):
    return pa.table({"rows": [engine.rows()]})


busiest = Question("busiest", "rows", "rows", None, count_rows)
"""
POINTS = """[gripmap.estimators]
at-least = their_plugin:bank
[gripmap.tyre_curves]
brush = their_plugin:brush
steep = their_plugin:steep
[gripmap.sources]
mine = their_plugin:blocks
[gripmap.questions]
busiest = their_plugin:busiest
"""


class PluginSite(NamedTuple):
    """Folder with an installed plug-in distribution (`PLUGIN`, `POINTS`) and a recorded drive."""

    folder: Path
    log: Path

    def run_code(self, code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run Python code in a process that finds the plug-in and this repository."""
        search_path = os.pathsep.join([str(self.folder), str(ROOT)])
        return subprocess.run(
            [sys.executable, "-c", code, *arguments],
            capture_output=True,
            text=True,
            check=False,
            env={**os.environ, "PYTHONPATH": search_path},
        )

    def run_command(self, package: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run the command line of a package: `edge_agent` or `fleet_service`."""
        code = f"import sys, gripmap; sys.exit(gripmap.{package}_main())"
        return self.run_code(code, *arguments)

    def replay(self, estimator: str) -> subprocess.CompletedProcess[str]:
        """Estimate the recorded drive; the estimates are written to `estimates`."""
        options = ["--estimator", estimator, "--out", str(self.estimates)]
        return self.run_command("edge_agent", "replay", str(self.log), *options)

    @property
    def estimates(self) -> Path:
        """Return the path of the estimates."""
        return self.folder / "estimates.parquet"


@pytest.fixture
def plugin_site(tmp_path: Path) -> PluginSite:
    about = tmp_path / "their_plugin-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: their-plugin\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(POINTS)
    (tmp_path / "their_plugin.py").write_text(PLUGIN)
    log = tmp_path / "drive.parquet"
    files = ["--out", str(log), "--vehicle-out", str(log.with_suffix(".json"))]
    assert main(["simulate", "slalom", "--duration", "2", *files]) == 0
    return PluginSite(tmp_path, log)


@pytest.mark.campaign
def test_estimator_of_another_distribution_is_found(plugin_site: PluginSite) -> None:
    done = plugin_site.replay("at-least")
    assert done.returncode in (0, 3), done.stderr
    assert pq.read_table(plugin_site.estimates)["mu_lower"].to_numpy().max() > 0.11
    assert "at-least" in plugin_site.replay("no").stderr


@pytest.mark.campaign
def test_tyre_curve_of_another_distribution_changes_the_estimates(plugin_site: PluginSite) -> None:
    tables = []
    for estimator in ("ckf", "ckf@brush"):
        done = plugin_site.replay(estimator)
        assert done.returncode in (0, 3), done.stderr
        tables.append(pq.read_table(plugin_site.estimates))
    assert not tables[0].equals(tables[1])


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("estimator", "problem"),
    [
        ("ckf@steep", "tyre-curve: begins with slope 2"),
        ("ckf@no", "tyre-curve: 'no' is unknown"),
        ("sr-ukf@brush", "tyre-curve: sr-ukf uses its own"),
    ],
)
def test_unusable_tyre_curve_is_reported(
    plugin_site: PluginSite, estimator: str, problem: str
) -> None:
    done = plugin_site.replay(estimator)
    assert problem in done.stderr, done.stderr


@pytest.mark.campaign
def test_question_and_source_of_another_distribution_are_found(plugin_site: PluginSite) -> None:
    from tests.fleet_service.archive.reference_archive import DATA

    archive = str(DATA / "v1.0" / "archive")
    options = ["--archive", archive, "--as-it-lies", "--json"]
    done = plugin_site.run_command("fleet_service", "analyze", "busiest", *options)
    assert json.loads(done.stdout)["rows"] > 0, done.stderr
    code = "from schemas.runtime.plugins import SOURCES, load_entry_point; "
    code += "print(len(list(load_entry_point(SOURCES, 'mine')('1'))))"
    done = plugin_site.run_code(code)
    assert int(done.stdout) >= 10, done.stderr


def test_a_plug_in_that_cannot_be_loaded_is_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    from importlib.metadata import EntryPoint

    from schemas.runtime import plugins

    broken = {"odd": EntryPoint("odd", "no_such_module:bank", plugins.ESTIMATORS)}
    monkeypatch.setattr(plugins, "entry_points_of", lambda group: broken)
    with pytest.raises(
        InputError, match="estimator: 'odd' cannot be loaded from no_such_module:bank"
    ):
        edge_agent.make_bank("odd", [])


def test_broken_plug_in_is_named_and_breaks_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from importlib.metadata import EntryPoint

    from fleet_service.analytics.questions import QUESTIONS, known_questions, question_of
    from schemas.runtime import plugins

    (tmp_path / "raises_at_import.py").write_text("raise RuntimeError('no licence')\n")
    (tmp_path / "leaves_at_import.py").write_text("raise SystemExit\n")
    monkeypatch.syspath_prepend(tmp_path)
    names = ("raises_at_import", "leaves_at_import")
    broken = {name: EntryPoint(name, f"{name}:bank", "any") for name in names}
    monkeypatch.setattr(plugins, "entry_points_of", lambda group: broken)
    for name, reason in zip(names, ("no licence", "SystemExit"), strict=True):
        message = rf"estimator: '{name}' cannot be loaded from {name}:bank \({reason}\)"
        with pytest.raises(InputError, match=message):
            edge_agent.make_bank(name, [])
        with pytest.raises(InputError, match=f"question: '{name}' cannot be loaded"):
            question_of(name)
    assert len(list(edge_agent.known_estimators())) > len(names)
    assert known_questions() == QUESTIONS
    assert len(caplog.records) == len(names)
    assert question_of("grip") is QUESTIONS["grip"]


def test_public_packages_are_typed() -> None:
    for name in gripmap.FACES:
        folder = Path(str(importlib.import_module(name).__file__)).parent
        assert (folder / "py.typed").exists()
    assert isinstance(pa.__version__, str)
