"""Tests that faults of certificates, which Zenoh reports as an unreachable router, are named."""

from __future__ import annotations

import json
import re
import ssl
from datetime import UTC, datetime
from pathlib import Path

import pytest

from schemas.config import ZenohSettings
from schemas.runtime import zenoh_session
from schemas.runtime.certificates import find_certificate_faults, read_validity

x509 = pytest.importorskip("cryptography.x509")
from cryptography.hazmat.primitives import hashes, serialization  # noqa: E402 optional library
from cryptography.hazmat.primitives.asymmetric import ec  # noqa: E402

BEGIN = datetime(2026, 1, 1, tzinfo=UTC)
END = datetime(2026, 6, 1, tzinfo=UTC)
DURING = datetime(2026, 3, 1, tzinfo=UTC).timestamp()


def write_pair(folder: Path, name: str, end: datetime = END) -> None:
    """Write a self-signed certificate and its private key."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    certificate = x509.CertificateBuilder(
        subject, subject, key.public_key(), x509.random_serial_number(), BEGIN, end
    ).sign(key, hashes.SHA256())
    pem = serialization.Encoding.PEM
    (folder / f"{name}.pem").write_bytes(certificate.public_bytes(pem))
    form = serialization.PrivateFormat.PKCS8
    (folder / f"{name}.key").write_bytes(key.private_bytes(pem, form, serialization.NoEncryption()))


def make_settings(folder: Path, **more: str) -> ZenohSettings:
    tls = {
        "root_ca_certificate": folder / "trust.pem",
        "connect_certificate": folder / "car.pem",
        "connect_private_key": folder / "car.key",
    } | {name: folder / file for name, file in more.items()}
    config = {"transport/link/tls": {name: str(path) for name, path in tls.items()}}
    return ZenohSettings(connect=["tls/127.0.0.1:1"], config=config)


def explain_faults(settings: ZenohSettings) -> str:
    return zenoh_session.explain_faults(zenoh_session.configuration(settings))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("trust", "car", "other"):
        write_pair(tmp_path, name)
    (tmp_path / "junk.pem").write_text("junk")
    (tmp_path / "empty.pem").write_text("")
    pem = (tmp_path / "trust.pem").read_text()
    (tmp_path / "der.pem").write_bytes(ssl.PEM_cert_to_DER_cert(pem))
    (tmp_path / "commented.pem").write_text(f"# für den Router\n{pem}", encoding="utf-8")
    return tmp_path


@pytest.mark.parametrize(
    ("more", "now", "fault"),
    [
        ({}, DURING, ""),
        ({}, END.timestamp() + 1, "car.pem expired on 2026-06-01: renew it"),
        ({}, BEGIN.timestamp() - 1, "car.pem is valid from 2026-01-01: set the clock"),
        ({"connect_private_key": "other.key"}, DURING, "other.key is not the private key of"),
        ({"root_ca_certificate": "commented.pem"}, DURING, ""),
        ({"root_ca_certificate": "junk.pem"}, DURING, "junk.pem is not valid PEM: make it with"),
        ({"root_ca_certificate": "empty.pem"}, DURING, "empty.pem is not valid PEM: make it with"),
        ({"root_ca_certificate": "der.pem"}, DURING, "der.pem is not valid PEM: make it with"),
        ({"connect_certificate": "junk.pem"}, DURING, "car.key is not valid PEM, or has a"),
        ({"connect_private_key": "junk.pem"}, DURING, "junk.pem is not valid PEM, or has a"),
    ],
)
def test_each_fault_of_a_certificate_is_named(
    folder: Path, more: dict[str, str], now: float, fault: str
) -> None:
    config = zenoh_session.configuration(make_settings(folder, **more))
    found = find_certificate_faults(config, now)
    assert bool(found) == bool(fault)
    assert not fault or any(fault in one for one in found)


@pytest.mark.parametrize("endpoint", ["tls/map.example:7447", "quic/map.example:7447"])
def test_encryption_without_certificates_says_where_to_name_them(endpoint: str) -> None:
    plain = ZenohSettings(connect=["tcp/127.0.0.1:1"])
    with_tls = ZenohSettings(connect=["tcp/127.0.0.1:1", endpoint])
    assert "name them in the settings" in explain_faults(with_tls)
    assert not explain_faults(plain)


def test_validity_is_that_of_the_certificate(tmp_path: Path) -> None:
    late = datetime(2060, 1, 1, tzinfo=UTC)
    write_pair(tmp_path, "long", late)
    text = (tmp_path / "long.pem").read_text()
    assert read_validity(text) == (BEGIN.timestamp(), late.timestamp())


def test_settings_of_a_reader_name_certificates() -> None:
    text = (Path(__file__).parents[3] / "deploy/secure/reader.json").read_text()
    text = re.sub(r'"/etc/\S+"', json.dumps(__file__), text)
    settings = ZenohSettings.model_validate(json.loads(text)["zenoh"])
    assert "name them in the settings" not in explain_faults(settings)
