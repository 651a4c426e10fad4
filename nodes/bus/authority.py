"""An authority of one's own: certificates for aircraft and desks, and what each of them needs as a folder (a bundle).

An authority is a folder with its key, its certificate and a list of whom it has certified. Every bundle holds a Zenoh
configuration with encryption (both ends show a certificate) and an access list: an aircraft publishes on its own
platform alone, a desk reads, and publishes its verdicts. The access list names all who are certified and not revoked,
so bundles are written anew when somebody is added or revoked.
"""

from __future__ import annotations

import base64
import datetime
import ipaddress
import json
import os
import re
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from ..errors import UserError

#: Kinds of whom is certified.
AIRCRAFT, DESK = "aircraft", "desk"
#: Port on which a secure platform meets.
SECURE_PORT = 7447
#: How long certificates hold: of the authority, and of others unless another time is asked for, days.
AUTHORITY_DAYS, DAYS = 3650, 730
#: Files of a bundle and of an authority.
KEY, CERTIFICATE, AUTHORITY, CONFIGURATION, FACTS = (
    "key.pem", "certificate.pem", "authority.pem", "zenoh.json5", "bundle.json",
)  # fmt: skip
#: What certificates are for: every peer listens and calls.
USES = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
_MESSAGES = (
    "put", "delete", "reply", "query", "declare_subscriber", "declare_queryable", "liveliness_token",
    "liveliness_query", "declare_liveliness_subscriber",
)  # fmt: skip
_READING = ("query", "declare_subscriber", "liveliness_query", "declare_liveliness_subscriber")
#: What a desk may publish, of any platform: verdicts, and that its own onlookers live.
DESK_TOPICS = ("observation/verdict", "status/monitor", "status/viewer")
_DESK_TOKENS = ("alive/monitor", "alive/viewer")


@dataclass
class Certified:
    """Somebody whom an authority has certified.

    Attributes
    ----------
    name, kind : of an aircraft (its platform) or a desk
    serial : of the certificate, hexadecimal
    until : last day, ISO
    hosts : addresses and host names at which it listens (aircraft) or which it calls (desk)
    port : on which the platform meets
    revoked : day, "" if not
    """

    name: str
    kind: str
    serial: str
    until: str
    hosts: list[str] = field(default_factory=list)
    port: int = SECURE_PORT
    revoked: str = ""


class Authority:
    """The folder of an authority.

    Parameters
    ----------
    folder : with its files

    Raises
    ------
    UserError : there is none, or its files are damaged
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            self._facts = json.loads((folder / "authority.json").read_text())
            self.members = [Certified(**entry) for entry in self._facts["members"]]
            self.name: str = self._facts["name"]
            self._key = serialization.load_pem_private_key((folder / KEY).read_bytes(), None)
            self._certificate = x509.load_pem_x509_certificate((folder / CERTIFICATE).read_bytes())
        except FileNotFoundError:
            raise UserError(f"{folder}: no authority, `triline keys new {folder}` makes one") from None
        except (ValueError, KeyError, TypeError, RecursionError):
            raise UserError(f"{folder}: the files of this authority are damaged") from None

    @classmethod
    def create(cls, folder: Path) -> Authority:
        """A new authority; its name is that of the folder.

        Raises
        ------
        UserError : there is one already, or no name
        """
        name = _named(folder.resolve().name)
        if (folder / "authority.json").exists():
            raise UserError(f"{folder}: is an authority already, wanted a new folder")
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        use = x509.KeyUsage(
            digital_signature=False, content_commitment=False, key_encipherment=False, data_encipherment=False,
            key_agreement=False, key_cert_sign=True, crl_sign=True, encipher_only=False, decipher_only=False,
        )  # fmt: skip
        certificate = (
            _begun(subject, subject, key.public_key(), AUTHORITY_DAYS)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(use, critical=True)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
            .sign(key, hashes.SHA256())
        )
        folder.mkdir(parents=True, exist_ok=True)
        os.chmod(folder, 0o700)
        write_private(folder / KEY, _pem(key))
        (folder / CERTIFICATE).write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
        write_private(folder / "authority.json", json.dumps({"name": name, "members": []}).encode())
        return cls(folder)

    def certify(
        self,
        name: str,
        kind: str,
        hosts: list[str],
        port: int = SECURE_PORT,
        days: int = DAYS,
        now: datetime.datetime | None = None,
    ) -> Path:
        """Certify an aircraft or a desk; returns its bundle.

        Parameters
        ----------
        name : of the aircraft (its platform) or the desk
        kind : `AIRCRAFT` or `DESK`
        hosts : where an aircraft listens, or which aircraft a desk calls: addresses or host names
        port : on which the platform meets
        days : for which the certificate holds
        now : time of certification; None = that of this machine's clock

        Raises
        ------
        UserError : a name that is taken or cannot be one
        """
        _named(name)
        if name == self.name or any(member.name == name and not member.revoked for member in self.members):
            raise UserError(f"{name}: this name is taken in {self.folder}; revoke it first, or choose another")
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        listens = ["127.0.0.1", "localhost", *(hosts if kind == AIRCRAFT else [])]
        use = x509.KeyUsage(
            digital_signature=True, content_commitment=False, key_encipherment=False, data_encipherment=False,
            key_agreement=False, key_cert_sign=False, crl_sign=False, encipher_only=False, decipher_only=False,
        )  # fmt: skip
        identifier = x509.AuthorityKeyIdentifier.from_issuer_public_key(self._certificate.public_key())  # type: ignore[arg-type]
        certificate = (
            _begun(subject, self._certificate.subject, key.public_key(), days, now)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(use, critical=True)
            .add_extension(x509.ExtendedKeyUsage(USES), critical=False)
            .add_extension(x509.SubjectAlternativeName([_alternative(host) for host in listens]), critical=False)
            .add_extension(identifier, critical=False)
            .sign(self._key, hashes.SHA256())  # type: ignore[arg-type]
        )  # fmt: skip
        bundle = self.folder / name
        bundle.mkdir(exist_ok=True)
        os.chmod(bundle, 0o700)
        write_private(bundle / KEY, _pem(key))
        (bundle / CERTIFICATE).write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
        (bundle / AUTHORITY).write_bytes((self.folder / CERTIFICATE).read_bytes())
        until = certificate.not_valid_after_utc.date().isoformat()
        self.members = [member for member in self.members if member.name != name or member.revoked]
        self.members.append(Certified(name, kind, f"{certificate.serial_number:x}", until, hosts, port))
        self._save()
        return bundle

    def revoke(self, name: str) -> list[Certified]:
        """Strike somebody off all access lists; returns those whose bundles have to be copied again.

        Raises
        ------
        UserError : nobody of this name
        """
        found = [member for member in self.members if member.name == name and not member.revoked]
        if not found:
            known = ", ".join(member.name for member in self.valid) or "nobody"
            raise UserError(f"{name}: is not certified by {self.folder}, certified: {known}")
        found[0].revoked = datetime.datetime.now(datetime.UTC).date().isoformat()
        self._save()
        return self.valid

    @property
    def valid(self) -> list[Certified]:
        """Who is certified and not revoked."""
        return [member for member in self.members if not member.revoked]

    def _save(self) -> None:
        """Write the list and, with it, all access lists."""
        facts = {"name": self.name, "members": [asdict(member) for member in self.members]}
        write_private(self.folder / "authority.json", json.dumps(facts, indent=2).encode())
        for member in self.valid:
            self._write_bundle(member)

    def _write_bundle(self, member: Certified) -> None:
        bundle = self.folder / member.name
        revoked = {entry.serial: entry.name for entry in self.members if entry.revoked}
        facts = {**asdict(member), "authority": self.name, "revoked_serials": revoked}
        (bundle / FACTS).write_text(json.dumps(facts, indent=2) + "\n")
        settings = zenoh_settings(bundle, member) | {"access_control": self._access_list()}
        tree: dict[str, Any] = {}
        for path, value in settings.items():
            *parents, last = path.split("/")
            place = tree
            for parent in parents:
                place = place.setdefault(parent, {})
            place[last] = value
        head = f"// Zenoh for {member.kind} {member.name}, by `triline keys`. It holds a private key: keep it secret.\n"
        write_private(bundle / CONFIGURATION, (head + json.dumps(tree, indent=2) + "\n").encode())

    def _access_list(self) -> dict[str, Any]:
        """Who may send what to whoever uses this list: all that is not allowed is dropped."""
        rules: list[dict[str, Any]] = [_rule("out", "egress", _MESSAGES, ["triline/**"])]
        subjects: list[dict[str, Any]] = [{"id": "everybody"}]
        policies = [{"rules": ["out"], "subjects": ["everybody"]}]
        for member in self.valid:
            if member.kind == AIRCRAFT:
                id = f"aircraft-{member.name}"
                rules.append(_rule(id, "ingress", _MESSAGES, [f"triline/{member.name}/**"]))
                subjects.append({"id": id, "cert_common_names": [member.name]})
                policies.append({"rules": [id], "subjects": [id]})
        desks = [member.name for member in self.valid if member.kind == DESK]
        if desks:
            rules.append(_rule("desk-reads", "ingress", _READING, ["triline/**"]))
            rules.append(_rule("desk-says", "ingress", ("put",), [f"triline/*/{topic}" for topic in DESK_TOPICS]))
            rules.append(
                _rule("desk-lives", "ingress", ("liveliness_token",), [f"triline/*/{key}" for key in _DESK_TOKENS])
            )
            subjects.append({"id": "desks", "cert_common_names": desks})
            policies.append({"rules": ["desk-reads", "desk-says", "desk-lives"], "subjects": ["desks"]})
        return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects,
                "policies": policies}  # fmt: skip


def zenoh_settings(bundle: Path, member: Certified) -> dict[str, Any]:
    """Settings of Zenoh for encryption and where to listen and call, by their paths."""

    def file(name: str) -> str:
        return base64.b64encode((bundle / name).read_bytes()).decode()

    here = f"tls/127.0.0.1:{member.port}"
    if member.kind == AIRCRAFT:
        listen = [here, *(f"tls/{_endpoint(host)}:{member.port}" for host in member.hosts)]
        listen += ["tls/127.0.0.1:0", *(f"tls/{_endpoint(host)}:0" for host in member.hosts)]
        connect = [here]
    else:
        listen = ["tls/127.0.0.1:0"]
        connect = [f"tls/{_endpoint(host)}:{member.port}" for host in member.hosts] or [here]
    tls = "transport/link/tls"
    return {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        "listen/endpoints": listen,
        "listen/timeout_ms": 0,
        "listen/exit_on_failure": False,
        "connect/endpoints": connect,
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5},
        "transport/shared_memory/enabled": False,
        "transport/link/protocols": ["tls"],
        "transport/link/tx/lease": 4000,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 2_000_000,
        f"{tls}/enable_mtls": True,
        f"{tls}/verify_name_on_connect": True,
        f"{tls}/close_link_on_expiration": True,
        f"{tls}/root_ca_certificate_base64": file(AUTHORITY),
        f"{tls}/listen_certificate_base64": file(CERTIFICATE),
        f"{tls}/listen_private_key_base64": file(KEY),
        f"{tls}/connect_certificate_base64": file(CERTIFICATE),
        f"{tls}/connect_private_key_base64": file(KEY),
        "timestamping/enabled": True,
    }


def _rule(id: str, flow: str, messages: tuple[str, ...], keys: list[str]) -> dict[str, Any]:
    # what latched topics need besides stands under @adv, which ** does not match
    both = [expression for key in keys for expression in (key, f"{key}/@adv/**")]
    return {"id": id, "permission": "allow", "flows": [flow], "messages": list(messages), "key_exprs": both}


def _begun(
    subject: x509.Name, issuer: x509.Name, key: Any, days: int, now: datetime.datetime | None = None
) -> x509.CertificateBuilder:
    now = now or datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))  # clocks on board
        .not_valid_after(now + datetime.timedelta(days=days))
    )


def _named(name: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,39}", name):
        raise UserError(f"{name!r}: wanted a name of letters, digits, - and _, at most 40")
    return name


def _alternative(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _endpoint(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def write_private(path: Path, data: bytes) -> None:
    """Write a file that only its owner reads, from its first byte on, and that is whole or the one before."""
    part = path.with_name(path.name + ".part")
    part.unlink(missing_ok=True)
    descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(data)
    os.replace(part, path)
