"""Tests that `fleet-service certs`, which issues certificates, works whatever certificates its
folder already contains.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509

from fleet_service.cli import main
from fleet_service.enrolment import authority as ca
from fleet_service.enrolment.enrol import Registry, ValidityPeriods
from schemas.errors import InputError
from tests.secured import READER, ROUTERS, SERVICE, VEHICLES, WEATHER, make_enrolment

NOW = datetime(2026, 3, 1, tzinfo=UTC)
EVERYONE = {*ROUTERS, SERVICE, READER, WEATHER, *VEHICLES}


def at(folder: Path, days: float = 0.0, **terms: float) -> Registry:
    """Return the certificate registry of a folder, opened as if `days` days had passed."""
    return Registry(folder, ValidityPeriods(**terms), NOW + timedelta(days=days))


def certificate(folder: Path, name: str) -> x509.Certificate:
    found = ca.read_certificate(folder / f"{name}.pem")
    assert found is not None
    return found


def read_trusted(folder: Path) -> list[x509.Certificate]:
    return x509.load_pem_x509_certificates((folder / "trust.pem").read_bytes())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    at(tmp_path).enrol(make_enrolment())
    return tmp_path


def test_everyone_on_the_list_gets_a_certificate_of_the_authority(folder: Path) -> None:
    (authority,) = read_trusted(folder)
    for name in EVERYONE:
        found = certificate(folder, name)
        assert ca.is_signed_by(found, authority)
        assert found.subject.rfc4514_string() == f"CN={name}"
        assert found.not_valid_after_utc == NOW + timedelta(days=365)
        uses = found.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        assert (x509.oid.ExtendedKeyUsageOID.SERVER_AUTH in uses) == (name in ROUTERS), (
            "only a router is a server"
        )
        assert ca.read_pair(folder / name) is not None, "key and certificate belong together"


def test_private_keys_are_for_their_owner_alone(folder: Path) -> None:
    keys = list(folder.rglob("*.key"))
    assert len(keys) == len(EVERYONE) + 1
    assert {oct(path.stat().st_mode & 0o777) for path in keys} == {"0o600"}
    assert oct((folder / "authority").stat().st_mode & 0o777) == "0o700"


def test_repeated_enrolment_changes_no_file(folder: Path) -> None:
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    done = at(folder, 1.0).enrol(make_enrolment())
    assert set(done.kept) == EVERYONE
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_expiring_certificates_are_issued_again(folder: Path) -> None:
    assert not at(folder, 334.0).enrol(make_enrolment()).issued
    assert set(at(folder, 336.0).enrol(make_enrolment()).issued) == EVERYONE
    assert certificate(folder, SERVICE).not_valid_after_utc == NOW + timedelta(days=336 + 365)


def test_a_router_with_another_address_gets_another_certificate(folder: Path) -> None:
    moved = make_enrolment(routers={"router-a": {"hosts": ["10.0.0.7"]}, "router-b": {}})
    assert at(folder).enrol(moved).issued == ["router-a"]
    names = (
        certificate(folder, "router-a")
        .extensions.get_extension_for_class(x509.SubjectAlternativeName)
        .value
    )
    assert [str(address) for address in names.get_values_for_type(x509.IPAddress)] == ["10.0.0.7"]


def test_a_pair_that_was_cut_off_half_way_is_made_whole(folder: Path) -> None:
    (folder / f"{READER}.key").write_bytes((folder / f"{SERVICE}.key").read_bytes())
    assert at(folder).enrol(make_enrolment()).issued == [READER]
    assert ca.read_pair(folder / READER) is not None


def test_removed_name_is_revoked_and_not_issued_until_expiry(folder: Path) -> None:
    gone, left = VEHICLES
    fewer = make_enrolment(vehicles=[left])
    assert at(folder).enrol(fewer).revoked == [gone]
    assert not (folder / f"{gone}.key").exists()
    assert gone not in (folder / "router-a.json5").read_text()
    with pytest.raises(
        InputError, match=f"^fleet: '{gone}' was revoked .* until 2027-03-01; give another name$"
    ):
        at(folder, 1.0).enrol(make_enrolment())
    assert gone in at(folder, 366.0).enrol(make_enrolment()).issued


def test_revoked_name_is_refused_as_long_as_its_authority_is_trusted(folder: Path) -> None:
    fewer = make_enrolment(vehicles=list(VEHICLES[1:]))
    at(folder).enrol(fewer, "next")
    at(folder).enrol(fewer, "switch")
    with pytest.raises(InputError, match=f"^fleet: '{VEHICLES[0]}' was revoked"):
        at(folder).enrol(make_enrolment())
    assert VEHICLES[0] in at(folder).enrol(make_enrolment(), "drop").issued


def test_change_of_authority_takes_three_steps_with_both_trusted(folder: Path) -> None:
    (first,) = read_trusted(folder)
    assert not at(folder).enrol(make_enrolment(), "next").issued, (
        "everyone must trust it before it signs"
    )
    assert first in read_trusted(folder)
    assert len(read_trusted(folder)) == 2
    assert set(at(folder).enrol(make_enrolment(), "switch").issued) == EVERYONE
    second = read_trusted(folder)[0]
    assert set(read_trusted(folder)) == {first, second}
    assert ca.is_signed_by(certificate(folder, SERVICE), second)
    assert set(at(folder).enrol(make_enrolment(), "drop").kept) == EVERYONE
    assert read_trusted(folder) == [second]


def test_a_step_out_of_order_is_refused(folder: Path) -> None:
    with pytest.raises(InputError, match=r"^ca: there is no next authority; begin with --ca next"):
        at(folder).enrol(make_enrolment(), "switch")


def test_no_certificate_outlives_its_authority(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"^days: the authority's certificate ends earlier, on 2026-04-10; "
    ):
        at(tmp_path, ca_days=40.0).enrol(make_enrolment())


def test_lost_key_of_the_authority_is_reported_and_not_replaced(folder: Path) -> None:
    (folder / "authority" / "ca.key").unlink()
    with pytest.raises(InputError, match=r"lacks the authority's key; restore ca.key"):
        at(folder).enrol(make_enrolment())


# A long name with a wrong character near its end. A pattern that can match the part before in many
# ways would try all of them.
LONG = "a" * 62 + "_b"


@pytest.mark.parametrize(
    "host", ["a", "r-1.example.org", "127.0.0.1", "::1", "a" * 63 + ".b", "xn--bcher-kva.example."]
)
def test_names_and_addresses_of_hosts_are_hosts(host: str) -> None:
    assert make_enrolment(routers={"r-1": {"hosts": [host]}}).routers["r-1"].hosts == [host]


@pytest.mark.parametrize(
    "host", ["", "-a", "a-", "a..b", ".a", "a_b", "a" * 64, "a b", "a\n", ".".join(["ab"] * 100)]
)
def test_invalid_host_is_refused(host: str) -> None:
    with pytest.raises(ValueError, match="is neither a host name nor an address"):
        make_enrolment(routers={"r-1": {"hosts": [host]}})


@pytest.mark.parametrize(
    ("fleet", "options", "expected"),
    [
        ({"routers": {}}, [], "error: routers: "),
        ({"routers": {"r-1": {}}, "vehicles": ["a/b"]}, [], "error: vehicles.0: "),
        (
            {"routers": {"r-1": {}}, "vehicles": ["shard-0"]},
            [],
            "error: content: 'shard-0' occurs twice, but a name has only one role; correct",
        ),
        (
            {"routers": {"r-1": {"hosts": ["a b"]}}},
            [],
            "error: routers.r-1.hosts.0: 'a b' is neither a host name",
        ),
        (
            {"routers": {"r-1": {"listen": "notanip"}}},
            [],
            "error: routers.r-1.listen: 'notanip' is no address, as 127.0.0.1 or :: (all)",
        ),
        (
            {"routers": {"r-1": {"hosts": [LONG]}}},
            [],
            "error: routers.r-1.hosts.0: 'aaaa",
        ),
        ({"routers": {"r-1": {}}, "cars": []}, [], "error: cars: "),
        ({"routers": {"r-1": {}}}, ["--days", "-1"], "error: days: -1 is not a valid duration; "),
        ({"routers": {"r-1": {}}}, ["--days", "nan"], "error: days: nan is not a valid duration; "),
        (
            {"routers": {"r-1": {}}},
            ["--days", "20"],
            "error: renew-days: is not less than the 20 days",
        ),
        ({"routers": {"r-1": {}}}, ["--ca", "switch"], "error: ca: there is no next authority; "),
    ],
)
def test_invalid_enrolment_is_reported_in_one_line(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    fleet: object,
    options: list[str],
    expected: str,
) -> None:
    file = tmp_path / "fleet.json"
    file.write_text(json.dumps(fleet))
    assert main(["certs", "--fleet", str(file), "--out", str(tmp_path / "out"), *options]) == 2
    shown = capsys.readouterr().err
    assert shown.startswith(expected), shown
    assert shown.count("\n") == 1


def test_certs_prints_its_results_and_the_next_steps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "fleet.json"
    file.write_text(json.dumps({"routers": {"router-a": {}}, "vehicles": ["car-1", "car-2"]}))
    assert main(["certs", "--fleet", str(file), "--out", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "issued 4: router-a, shard-0, car-1, car-2",
        f"routers: restart router-a one at a time, each with its file in {tmp_path / 'out'}",
    ]


def test_foreign_files_stay_and_no_private_key_is_deleted(
    folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    other = tmp_path_factory.mktemp("other")
    at(other).enrol(make_enrolment())
    for ending in (".pem", ".key"):
        (folder / f"nginx{ending}").write_bytes((other / f"{SERVICE}{ending}").read_bytes())
    (folder / "notes.pem").write_text("no certificate at all")
    gone = VEHICLES[0]
    key = (folder / f"{gone}.key").read_bytes()
    assert at(folder).enrol(make_enrolment(vehicles=list(VEHICLES[1:]))).revoked == [gone]
    assert (folder / "nginx.pem").exists()
    assert (folder / "nginx.key").exists()
    assert (folder / "notes.pem").exists()
    assert (folder / "revoked" / f"{gone}.key").read_bytes() == key
    assert (folder / "revoked" / f"{gone}.key").stat().st_mode & 0o077 == 0


def test_mass_revocation_needs_confirmation(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = [f"car-{k:03}" for k in range(6)]
    words = ["certs", "--fleet", str(tmp_path / "fleet.json"), "--out", str(tmp_path / "certs")]
    (tmp_path / "fleet.json").write_text(make_enrolment(vehicles=names).model_dump_json())
    assert main(words) == 0
    (tmp_path / "fleet.json").write_text(make_enrolment(vehicles=names[:2]).model_dump_json())
    capsys.readouterr()
    assert main([*words, "--dry-run"]) == 0
    assert capsys.readouterr().out == f"would revoke 4: {', '.join(names[2:])}\n"
    assert main(words) == 2
    assert "4 names with a certificate are not on the list" in capsys.readouterr().err
    assert len(list((tmp_path / "certs").glob("car-*.pem"))) == 6
    assert main([*words, "--revoke", "4"]) == 0
    assert len(list((tmp_path / "certs").glob("car-*.pem"))) == 2
