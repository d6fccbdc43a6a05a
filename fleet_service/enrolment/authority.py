"""Certificate authority in a folder, and the certificates that it issues (elliptic curve P-256,
X.509 version 3).

    DIR/authority/ca.pem  ca.key      current authority; its key stays on this machine
    DIR/authority/next.*  old.pem     next authority, and previous one, during a change of authority
    DIR/trust.pem                     authorities that all participants trust
    DIR/NAME.pem  NAME.key            certificate and key of each name
    DIR/revoked/NAME.pem              certificates of names that were removed from the list
"""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Final, NamedTuple

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from schemas.errors import InputError
from schemas.runtime.durable import open_durably

SKEW: Final = timedelta(minutes=10)  # how far a vehicle's clock may be behind the authority's
Key = ec.EllipticCurvePrivateKey


class KeyPair(NamedTuple):
    """X.509 certificate together with its private key."""

    certificate: x509.Certificate
    key: Key

    def write(self, stem: Path) -> None:
        """Write the certificate to STEM.pem and its private key to STEM.key. If the machine fails
        after the first file, `read_pair` detects this.
        """
        secret = self.key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
        write_atomically(stem.with_name(stem.name + ".key"), secret, 0o600)
        write_atomically(stem.with_name(stem.name + ".pem"), to_pem(self.certificate), 0o644)


def to_pem(certificate: x509.Certificate) -> bytes:
    """Return a certificate in PEM format."""
    return certificate.public_bytes(serialization.Encoding.PEM)


def write_atomically(path: Path, data: bytes, mode: int) -> None:
    """Replace the content of a file atomically (a reader sees the old or the new content); its
    permissions are never wider than `mode`.
    """
    with open_durably(path, mode) as file:
        file.write(data)


def read_pair(stem: Path) -> KeyPair | None:
    """Return the certificate STEM.pem and the private key STEM.key; None if a file is missing or
    the two do not match.

    Raises:
        InputError: a file exists and is not valid.
    """
    certificate = read_certificate(stem.with_name(stem.name + ".pem"))
    path = stem.with_name(stem.name + ".key")
    if certificate is None or not path.exists():
        return None
    try:
        key = serialization.load_pem_private_key(path.read_bytes(), None)
    except (ValueError, TypeError) as error:
        raise InputError(
            "out", f"{path} is not a private key", "move it away; it will be created again"
        ) from error
    if not isinstance(key, Key) or key.public_key() != certificate.public_key():
        return None
    return KeyPair(certificate, key)


def read_certificate(path: Path) -> x509.Certificate | None:
    """Return the certificate in a file; None if the file does not exist.

    Raises:
        InputError: the file is not a certificate.
    """
    if not path.exists():
        return None
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except ValueError as error:
        raise InputError(
            "out", f"{path} is not a certificate", "move it away; it will be created again"
        ) from error


def new_authority(days: float, now: datetime) -> KeyPair:
    """Return a new self-signed certificate authority, valid for `days`, that cannot sign other
    authorities.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    name = _subject_name(f"gripmap authority {now:%Y-%m-%d} {x509.random_serial_number():x}"[:64])
    certificate = (
        _certificate_builder(name, name, key, now, now + timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_key_usage(signs=True), critical=True)
        .sign(key, hashes.SHA256())
    )
    return KeyPair(certificate, key)


def issue_certificate(
    authority: KeyPair, name: str, hosts: Sequence[str], days: float, now: datetime
) -> KeyPair:
    """Issue a certificate for a name; with `hosts` it is also valid for a server at these host
    names.

    Raises:
        InputError: the certificate would outlive the authority.
    """
    until = now + timedelta(days=days)
    if until > authority.certificate.not_valid_after_utc:
        end = authority.certificate.not_valid_after_utc
        raise InputError(
            "days",
            f"the authority's certificate ends earlier, on {end:%Y-%m-%d}",
            "give fewer days, or introduce a new authority (--ca next)",
        )
    key = ec.generate_private_key(ec.SECP256R1())
    uses = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if hosts else [])]
    certificate = (
        _certificate_builder(_subject_name(name), authority.certificate.subject, key, now, until)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_key_usage(signs=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
        .add_extension(x509.SubjectAlternativeName(alternative_names(name, hosts)), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key()),
            critical=False,
        )
        .sign(authority.key, hashes.SHA256())
    )
    return KeyPair(certificate, key)


def alternative_names(name: str, hosts: Sequence[str]) -> list[x509.GeneralName]:
    """Return the host names and addresses that a certificate for `name` must list as alternative
    names.
    """
    found: list[x509.GeneralName] = [x509.DNSName(name)]
    for host in hosts:
        try:
            found.append(x509.IPAddress(ipaddress.ip_address(host)))
        except ValueError:
            found.append(x509.DNSName(host))
    return found


def is_signed_by(certificate: x509.Certificate, authority: x509.Certificate) -> bool:
    """Return True if the certificate authority issued the certificate."""
    try:
        certificate.verify_directly_issued_by(authority)
    # In this order: signed by another key, issued by another name, or another type of key.
    except (InvalidSignature, ValueError, TypeError):
        return False
    return True


def _subject_name(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _certificate_builder(
    subject: x509.Name, issuer: x509.Name, key: Key, now: datetime, until: datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - SKEW)
        .not_valid_after(until)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _key_usage(*, signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs,
        key_cert_sign=signs,
        crl_sign=signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )
