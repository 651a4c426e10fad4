"""A bundle in use: what is wrong with it, what it allows, and why a connection with it comes to nothing.

Zenoh tells nothing but a time-out where certificates do not go together. So a bundle is checked before it is used, and
where nobody answers the other end is asked once more with the ssl module, which says why.
"""

from __future__ import annotations

import datetime
import json
import re
import socket
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.x509.oid import NameOID

from ..errors import UserError
from .authority import (
    AIRCRAFT,
    AUTHORITY,
    CERTIFICATE,
    CONFIGURATION,
    DESK,
    DESK_TOPICS,
    FACTS,
    GROUND_LINK,
    KEY,
    ROUTER,
    USES,
)

#: How long the other end is given to answer, s.
PROBE_S = 2.0
#: A certificate that expires within so many days is told.
SOON_DAYS = 30
#: It is told again where so many days are left, 1/24 is an hour, and when it has expired.
AGAIN_DAYS = (SOON_DAYS, 7, 1, 1 / 24, 0)


@dataclass(frozen=True)
class Bundle:
    """A bundle that was checked.

    Attributes
    ----------
    folder : its folder
    name, kind : whose it is: an aircraft's, a router's or a desk's
    authority : name of who certified it
    port : on which the platform meets
    revoked : serial (hexadecimal) -> name of certificates that no longer count
    until : when the certificate, or that of the authority, expires
    """

    folder: Path
    name: str
    kind: str
    authority: str
    revoked: dict[str, str]
    port: int
    until: datetime.datetime

    def ends_soon(self, now: datetime.datetime | None = None) -> str:
        """A line where the certificate expires within `SOON_DAYS`, or has; "" where not."""
        left = self.until - (now or datetime.datetime.now(datetime.UTC))
        if left > datetime.timedelta(days=SOON_DAYS):
            return ""
        expires = "expires" if left > datetime.timedelta() else "expired"
        return (
            f"the certificate of {self.name!r} {expires} on {self.until:%Y-%m-%d %H:%M} UTC: "
            "from then on no program hears another, and nothing is recorded"
        )

    @property
    def is_desk(self) -> bool:
        """Whether it is of a program that reads, and publishes nothing but verdicts."""
        return self.kind == DESK

    @property
    def configuration(self) -> Path:
        """The Zenoh configuration."""
        return self.folder / CONFIGURATION

    @property
    def ground_link(self) -> Path | None:
        """The Zenoh configuration of an aircraft's link to routers on the ground; None where it calls none."""
        path = self.folder / GROUND_LINK
        return path if self.kind == AIRCRAFT and path.is_file() else None

    def refuses(self, platform: str, topic: str) -> str:
        """Why its owner cannot publish a topic of a platform; "" if it may."""
        if self.kind == AIRCRAFT:
            return "" if platform == self.name else f"aircraft {self.name!r} cannot publish for platform {platform!r}"
        if self.kind == ROUTER:
            return f"router {self.name!r} cannot publish {topic}: a router hands on what others publish"
        if topic in DESK_TOPICS:
            return ""
        return f"desk {self.name!r} cannot publish {topic}: a desk reads, and publishes {', '.join(DESK_TOPICS)}"

    def why_nobody(self, endpoints: list[str]) -> str:
        """What is wrong with the connection to endpoints such as ``tls/10.0.0.1:7447``; "" if nothing is seen."""
        told = []
        for endpoint in endpoints:
            found = re.fullmatch(r"tls/\[?([^\]]+?)\]?:(\d+)", endpoint)
            if found and int(found[2]):
                told.append(self._probe(found[1], int(found[2])))
        return "; ".join(dict.fromkeys(filter(None, told)))

    def _probe(self, host: str, port: int) -> str:
        place = f"{host}:{port}"
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.load_verify_locations(self.folder / AUTHORITY)
        context.load_cert_chain(self.folder / CERTIFICATE, self.folder / KEY)
        try:
            with socket.create_connection((host, port), PROBE_S) as plain:
                plain.settimeout(PROBE_S)
                with context.wrap_socket(plain, server_hostname=host) as link:
                    serial = (link.getpeercert() or {}).get("serialNumber", "")
                    revoked = self.revoked.get(str(serial).lower().lstrip("0"))
                    if revoked:
                        return f"{place}: the certificate of {revoked!r} there was revoked"
                    link.settimeout(0.5)
                    try:
                        link.recv(1)  # a refusal of our certificate comes after the handshake
                    except TimeoutError:
                        return ""
                    return f"{place}: closed the connection"
        except ssl.SSLCertVerificationError as error:
            return f"{place}: {_verification(error, self.authority)}"
        except ssl.SSLError as error:
            return f"{place}: {_alert(error)}"
        except TimeoutError:
            return f"{place}: does not answer in TLS (plain TCP, or another program)"
        except ConnectionRefusedError:
            return f"{place}: nobody listens there"
        except OSError as error:
            return f"{place}: {(error.strerror or str(error)).lower()}"


def speaks_tls(host: str, port: int) -> bool:
    """Whether a port answers in TLS."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        with socket.create_connection((host, port), PROBE_S) as plain:
            plain.settimeout(PROBE_S)
            with context.wrap_socket(plain):
                return True
    except ssl.SSLError as error:
        return "ALERT" in str(error.reason or "").upper()
    except OSError:
        return False


def _verification(error: ssl.SSLCertVerificationError, authority: str) -> str:
    text = (error.verify_message or "").lower()
    if "expired" in text:
        return "the certificate there has expired"
    if "not yet valid" in text:
        return "the certificate there is not valid yet: is the clock of this machine right?"
    if "mismatch" in text or "doesn't match" in text or "not valid for" in text:
        return "the certificate there is of another name than this address"
    return f"the certificate there is of another authority than {authority!r}"


def _alert(error: ssl.SSLError) -> str:
    reason = str(error.reason or error).upper()
    if "WRONG_VERSION_NUMBER" in reason or "RECORD_LAYER" in reason or "UNEXPECTED_EOF" in reason:
        return "does not answer in TLS (plain TCP, or another program)"
    if "EXPIRED" in reason:
        return "refuses this certificate: expired"
    if "UNKNOWN_CA" in reason or "DECRYPT_ERROR" in reason or "BAD_CERTIFICATE" in reason:
        return "refuses this certificate: of another authority"
    if "CERTIFICATE_REQUIRED" in reason:
        return "wants a certificate"
    return f"refuses the connection: {reason.lower().replace('_', ' ')}"


class ExpiryWatch:
    """Tells the user of a program that goes on for long when the certificate of its bundle expires: weeks, a day and an
    hour ahead, and when it has."""

    def __init__(self, bundle: Bundle) -> None:
        self.bundle, self._told = bundle, 0

    def look(self, now: datetime.datetime | None = None) -> str:
        """A line where another one of the times in `AGAIN_DAYS` has come since the last look; else ""."""
        now = now or datetime.datetime.now(datetime.UTC)
        left = self.bundle.until - now
        come = sum(left <= datetime.timedelta(days=days) for days in AGAIN_DAYS)
        if come <= self._told:
            return ""
        self._told = come
        return self.bundle.ends_soon(now)


def load_bundle(folder: Path, now: datetime.datetime | None = None) -> Bundle:
    """A bundle, checked.

    Raises
    ------
    UserError : a file is missing or damaged, the certificate has expired, is revoked, of another authority, without
        the uses it needs, or does not go with its key
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such bundle, `triline keys aircraft`, `router` or `desk` makes one")
    for name in (CERTIFICATE, KEY, AUTHORITY, CONFIGURATION, FACTS):
        if not (folder / name).is_file():
            what = {CERTIFICATE: "no certificate", KEY: "no private key"}.get(name, "not whole")
            raise UserError(f"{folder}: {what}: {name} is missing")
    try:
        facts: dict[str, Any] = json.loads((folder / FACTS).read_text())
        certificate = x509.load_pem_x509_certificate((folder / CERTIFICATE).read_bytes())
        authority = x509.load_pem_x509_certificate((folder / AUTHORITY).read_bytes())
        key = serialization.load_pem_private_key((folder / KEY).read_bytes(), None)
        until = min(certificate.not_valid_after_utc, authority.not_valid_after_utc)
        revoked, port = dict(facts["revoked_serials"]), int(facts["port"])
        bundle = Bundle(folder, facts["name"], facts["kind"], facts["authority"], revoked, port, until)
        common = str(certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)
        wanted = str(facts.get("common") or bundle.name)
        uses = set(certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)
    except (ValueError, KeyError, TypeError, IndexError, RecursionError, x509.ExtensionNotFound):
        raise UserError(f"{folder}: its files are damaged, wanted a bundle of `triline keys`") from None
    now = now or datetime.datetime.now(datetime.UTC)
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        raise UserError(f"{folder}: the certificate is of another authority than {AUTHORITY}") from None
    if certificate.public_key() != key.public_key():
        raise UserError(f"{folder}: the private key does not go with the certificate")
    for one, whose in ((certificate, "the certificate"), (authority, f"the authority {bundle.authority!r}")):
        if now > one.not_valid_after_utc:
            raise UserError(f"{folder}: {whose} expired on {one.not_valid_after_utc:%Y-%m-%d}")
        if now < one.not_valid_before_utc:
            when = f"{one.not_valid_before_utc:%Y-%m-%d %H:%M}"
            raise UserError(f"{folder}: {whose} is valid from {when} UTC on: is the clock of this machine right?")
    if f"{certificate.serial_number:x}" in bundle.revoked:
        raise UserError(f"{folder}: the certificate of {common!r} was revoked by {bundle.authority!r}")
    if common != wanted or bundle.kind not in (AIRCRAFT, DESK, ROUTER):
        raise UserError(f"{folder}: the certificate is of {common!r}, the bundle of {bundle.kind} {bundle.name!r}")
    if not set(USES) <= uses:
        raise UserError(f"{folder}: the certificate is for other uses, wanted server and client")
    if (folder / KEY).stat().st_mode & 0o077:
        raise UserError(f"{folder / KEY}: others can read this private key, wanted mode 600 (`chmod 600` it)")
    return bundle
