"""Search for faults of the certificates in a Zenoh configuration.

Zenoh reports each failed TLS connection as "unable to connect". This module finds the faults that
the own machine can see: no certificate, an expired one, or a private key of another certificate.
"""

from __future__ import annotations

import json
import re
import ssl
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import zenoh

TLS: Final = "transport/link/tls"
ROOT: Final = "root_ca_certificate"
ROLES: Final = ("connect", "listen")
_NONE: Final = (
    "TLS and QUIC need certificates: name them in the settings (--config), as "
    "deploy/secure/reader.json does"
)
_ENCRYPTED: Final = re.compile(r'"(tls|quic|quic_datagram)/')
_PEM: Final = re.compile(
    r"-----BEGIN CERTIFICATE-----.+?-----END CERTIFICATE-----", re.DOTALL | re.ASCII
)
# Validity of a certificate in DER (RFC 5280, 4.1.2.5): a sequence of two times, each either a
# UTCTime (tag 0x17) or a GeneralizedTime (tag 0x18).
_TIME: Final = rb"(\x17\x0d\d{12}Z|\x18\x0f\d{14}Z)"
_VALIDITY: Final = re.compile(rb"\x30[\x1e\x20\x22]" + _TIME + _TIME)
_PIVOT: Final = 50  # a UTCTime from year 50 on is in the 20th century


def find_certificate_faults(config: zenoh.Config, now: float) -> list[str]:
    """Return a message for each fault of the certificates of a Zenoh configuration; `now` is the
    time [s since 1970].
    """
    settings = json.loads(config.get_json(TLS))
    endpoints = config.get_json("connect/endpoints")
    own = (ROOT, "connect_certificate", f"{ROOT}_base64", "connect_certificate_base64")
    if _ENCRYPTED.search(endpoints) and not any(settings.get(name) for name in own):
        return [_NONE]
    faults: list[str] = []
    if root := settings.get(ROOT):
        faults += _find_faults(Path(root), None, now)
    for role in ROLES:
        certificate = settings.get(f"{role}_certificate")
        key = settings.get(f"{role}_private_key")
        if certificate and key:
            faults += _find_faults(Path(certificate), Path(key), now)
    return list(dict.fromkeys(faults))  # a router often has one certificate for both roles


def _find_faults(certificate: Path, key: Path | None, now: float) -> Iterator[str]:
    """Yield the faults of a certificate with its private key; those of an authority if `key` is
    None.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        text = certificate.read_text(encoding="ascii", errors="replace")
        if key is None:
            context.load_verify_locations(certificate)
        else:
            key.read_bytes()  # an error of the next line does not name the file
            context.load_cert_chain(certificate, key, password="")  # an encrypted key is refused
    except ssl.SSLError as error:
        if error.reason == "KEY_VALUES_MISMATCH":
            yield f"{key} is not the private key of {certificate}"
        else:
            problem = f"{certificate} is not valid PEM"
            if key is not None:
                problem = f"{certificate} or {key} is not valid PEM, or has a password"
            yield f"{problem}: make it with `fleet-service certs`"
        return
    except OSError as error:
        file = error.filename or certificate
        yield f"cannot read {file} ({error.strerror}): correct the path or the permissions"
        return
    for block in _PEM.findall(text):
        try:
            first, last = read_validity(block)
        except ValueError:  # a block that the TLS library skipped
            continue
        if now > last:
            date = f"{datetime.fromtimestamp(last, UTC):%Y-%m-%d}"
            yield f"{certificate} expired on {date}: renew it with `fleet-service certs`"
        elif now < first:
            date = f"{datetime.fromtimestamp(first, UTC):%Y-%m-%d}"
            yield f"{certificate} is valid from {date}: set the clock"


def read_validity(pem: str) -> tuple[float, float]:
    """Return the times [s since 1970] from which and until which a certificate is valid.

    Raises:
        ValueError: the text is not a certificate.
    """
    found = _VALIDITY.search(ssl.PEM_cert_to_DER_cert(pem))
    if found is None:
        raise ValueError("no validity")
    return _parse_time(found[1]), _parse_time(found[2])


def _parse_time(der: bytes) -> float:
    """Return a time in DER in seconds since 1970."""
    digits = der[2:-1].decode("ascii")
    if len(digits) == 12:
        digits = ("19" if int(digits[:2]) >= _PIVOT else "20") + digits
    return datetime.strptime(f"{digits}+0000", "%Y%m%d%H%M%S%z").timestamp()
