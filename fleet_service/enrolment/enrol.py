"""Enrolment of names: creates missing certificates and router configurations from the enrolment
file, and revokes the certificates of removed names.

A repeated run changes only certificates whose entry in the file has changed, or that are about to
expire.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import Final

from cryptography import x509

from fleet_service.enrolment import authority as ca
from fleet_service.enrolment.access import router_configuration
from fleet_service.enrolment.fleet import Enrolment, Step
from schemas.errors import InputError

PRIVATE: Final = 0o700  # file mode of the authority's folder


@dataclass(frozen=True)
class ValidityPeriods:
    """Validity periods of certificates and authorities [days].

    Attributes:
        days: validity of a certificate.
        ca_days: validity of an authority.
        renew_days: a certificate with less remaining validity is renewed.
    """

    days: float = 365.0
    ca_days: float = 3650.0
    renew_days: float = 30.0


@dataclass
class EnrolmentResult:
    """Result of an enrolment: names with a new certificate, names whose certificate was kept, and
    revoked names.
    """

    issued: list[str] = field(default_factory=list)
    kept: list[str] = field(default_factory=list)
    revoked: list[str] = field(default_factory=list)


class Registry:
    """Folder of a certificate authority, and the operations on it.

    Args:
        folder: folder for the authority's keys, all certificates and the routers' configurations;
            created if it does not exist.
        periods: validity periods.
        now: current time, with time zone.
        used_at: folder in which the routers will find their files (default: `folder`).
    """

    def __init__(
        self, folder: Path, periods: ValidityPeriods, now: datetime, used_at: Path | None = None
    ) -> None:
        self._folder = folder
        self._periods = periods
        self._now = now
        self._used_at = used_at or folder
        self._authority = folder / "authority"
        self._revoked = folder / "revoked"
        folder.mkdir(parents=True, exist_ok=True)
        for inner in (self._authority, self._revoked):
            inner.mkdir(mode=PRIVATE, exist_ok=True)

    def enrol(self, fleet: Enrolment, step: Step | None = None) -> EnrolmentResult:
        """Bring certificates and router configurations up to date with the enrolment file.

        Args:
            fleet: content of the enrolment file.
            step: step of the change to another authority (next, switch or drop) that is carried
                out; None for none.

        Raises:
            InputError: a file is damaged, a name was revoked, or a step is out of order.
        """
        signer = self._prepare_signer(step)
        done = EnrolmentResult()
        for name in fleet.names:
            hosts = fleet.routers[name].hosts if name in fleet.routers else []
            if self._is_usable(name, hosts, signer.certificate):
                done.kept.append(name)
            else:
                self._refuse_revoked(name)
                ca.issue_certificate(signer, name, hosts, self._periods.days, self._now).write(
                    self._folder / name
                )
                done.issued.append(name)
        done.revoked += self._revoke(self.list_leaving(fleet))
        self._write_trusted()
        for name in fleet.routers:
            text = json.dumps(router_configuration(fleet, name, self._used_at), indent=1)
            ca.write_atomically(self._folder / f"{name}.json5", text.encode() + b"\n", 0o644)
        return done

    def _prepare_signer(self, step: Step | None) -> ca.KeyPair:
        current = self._authority / "ca"
        coming = self._authority / "next"
        if step == "next" and ca.read_pair(coming) is None:
            ca.new_authority(self._periods.ca_days, self._now).write(coming)
        if step == "switch":
            self._switch_authority()
        if step == "drop":
            (self._authority / "old.pem").unlink(missing_ok=True)
        signer = ca.read_pair(current)
        if signer is None:
            if (self._authority / "ca.pem").exists():
                raise InputError(
                    "out",
                    f"{self._authority} lacks the authority's key",
                    "restore ca.key from its backup",
                )
            signer = ca.new_authority(self._periods.ca_days, self._now)
            signer.write(current)
        return signer

    def _switch_authority(self) -> None:
        """Let the next certificate authority sign all certificates from now on. An interrupted call
        can be repeated.
        """
        following = ca.read_pair(self._authority / "next")
        leaving = ca.read_certificate(self._authority / "ca.pem")
        if following is None or leaving is None:
            raise InputError(
                "ca",
                "there is no next authority",
                "begin with --ca next, and distribute trust.pem to everyone",
            )
        if leaving != following.certificate:
            ca.write_atomically(self._authority / "old.pem", ca.to_pem(leaving), 0o644)
        following.write(self._authority / "ca")
        for ending in (".key", ".pem"):
            (self._authority / f"next{ending}").unlink()

    def _is_usable(self, name: str, hosts: list[str], signer: x509.Certificate) -> bool:
        pair = ca.read_pair(self._folder / name)
        if pair is None:
            return False
        found = pair.certificate
        names = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        soon = self._now + timedelta(days=self._periods.renew_days)
        return (
            ca.is_signed_by(found, signer)
            and found.not_valid_after_utc > soon
            and list(names) == ca.alternative_names(name, hosts)
        )

    def _refuse_revoked(self, name: str) -> None:
        """Raise an error for a revoked name whose old certificate is still valid. The access list
        contains only names, so enrolling the name again would make the old, possibly stolen
        certificate valid again.
        """
        lost = ca.read_certificate(self._revoked / f"{name}.pem")
        if (
            lost is None
            or lost.not_valid_after_utc < self._now
            or not any(ca.is_signed_by(lost, signer) for signer in self._read_trusted())
        ):
            return
        until = f"{lost.not_valid_after_utc:%Y-%m-%d}"
        raise InputError(
            "fleet",
            f"{name!r} was revoked and its certificate is valid until {until}",
            "give another name",
        )

    def list_leaving(self, fleet: Enrolment) -> list[str]:
        """Return the names that have a certificate of this authority but are not in the enrolment
        file; `enrol` would revoke them.
        """
        signers = self._read_trusted()
        return [
            path.stem
            for path in sorted(self._folder.glob("*.pem"))
            if self._is_leaving(path, fleet, signers)
        ]

    def _is_leaving(self, path: Path, fleet: Enrolment, signers: list[x509.Certificate]) -> bool:
        """Return True if the file at `path` is a certificate of one of the authorities `signers`
        for a name that is not in the enrolment file.
        """
        if path.stem in {*fleet.names, "trust"}:
            return False
        try:
            found = ca.read_certificate(path)
        except InputError:
            return False
        return found is not None and any(ca.is_signed_by(found, signer) for signer in signers)

    def _revoke(self, gone: list[str]) -> list[str]:
        """Move certificates and keys of names that were removed from the enrolment file to
        `revoked/`.
        """
        for name in gone:
            # Move the certificate last, so that an interrupted call is repeated.
            for ending in (".key", ".json5", ".pem"):
                path = self._folder / f"{name}{ending}"
                if path.exists():
                    path.rename(self._revoked / path.name)
        return gone

    def _read_trusted(self) -> list[x509.Certificate]:
        """Return the certificates of the authorities that all participants trust."""
        found = (
            ca.read_certificate(self._authority / f"{name}.pem") for name in ("ca", "next", "old")
        )
        return [certificate for certificate in found if certificate is not None]

    def _write_trusted(self) -> None:
        trusted = b"".join(map(ca.to_pem, self._read_trusted()))
        ca.write_atomically(self._folder / "trust.pem", trusted, 0o644)
