"""An authority of one's own: certificates for aircraft, routers and desks, and what each of them needs as a folder (a
bundle).

An authority is a folder with its key, its certificate and a list of whom it has certified. Every bundle holds a Zenoh
configuration with encryption (both ends show a certificate) and an access list: an aircraft publishes on its own
platform alone, a router on the ground hands on what others may say, a desk reads, and publishes its verdicts. The
access list names all who are certified and not revoked, so bundles are written anew when somebody is added or revoked.
An aircraft that calls routers has a second configuration, for that link alone.
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
AIRCRAFT, DESK, ROUTER = "aircraft", "desk", "router"
#: Port on which a secure platform meets.
SECURE_PORT = 7447
#: How long certificates hold: of the authority, and of others unless another time is asked for, days.
AUTHORITY_DAYS, DAYS, LONGEST_DAYS = 3650, 730, 36500
#: Files of a bundle and of an authority.
KEY, CERTIFICATE, AUTHORITY, CONFIGURATION, FACTS = (
    "key.pem", "certificate.pem", "authority.pem", "zenoh.json5", "bundle.json",
)  # fmt: skip
#: The second configuration of an aircraft that calls routers: of its link to the ground.
GROUND_LINK = "ground.json5"
#: What certificates are for: every peer listens and calls.
USES = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
_MESSAGES = (
    "put", "delete", "reply", "query", "declare_subscriber", "declare_queryable", "liveliness_token",
    "liveliness_query", "declare_liveliness_subscriber",
)  # fmt: skip
_READING = ("query", "declare_subscriber", "liveliness_query", "declare_liveliness_subscriber")
#: What a desk may publish, of any platform: verdicts, and that its own onlookers live, which is no word of an aircraft.
DESK_STATUSES = ("status/monitor", "status/viewer", "status/ground")
DESK_TOPICS = ("observation/verdict", *DESK_STATUSES)
_DESK_TOKENS = ("alive/monitor", "alive/viewer", "alive/ground")
#: What an aircraft takes from the ground as a publication; all else that it takes are questions.
UPLINK_TOPICS = ("observation/verdict",)
_ASKING = ("query", "declare_subscriber", "declare_queryable", "liveliness_query", "declare_liveliness_subscriber")
_SAYING = ("put", "delete", "reply", "liveliness_token")
#: Of links to the ground: an end that is silent for so long is gone, ms; a publisher waits so long for a slow link, us,
#: before it counts as cut; and so many bytes wait in the socket and go together, so that what is urgent does not wait
#: behind them.
LEASE_MS, SLOW_US, SOCKET_BYTES, BATCH_BYTES = 8000, 20_000_000, 16_384, 8192
#: A router that does not answer for so long is not there, ms.
CALL_MS = 4000


@dataclass
class Certified:
    """Somebody whom an authority has certified.

    Attributes
    ----------
    name, kind : of an aircraft (its platform), a router or a desk
    serial : of the certificate, hexadecimal
    until : last day, ISO
    hosts : addresses and host names at which it listens (aircraft, router) or which it calls (desk)
    port : on which the platform meets, or the router listens
    revoked : day, "" if not
    routers : the routers that it calls, ``host:port``
    common : name in its certificate, by which access lists know it: another one than in any certificate that was
        revoked before under its name; "" is its name
    """

    name: str
    kind: str
    serial: str
    until: str
    hosts: list[str] = field(default_factory=list)
    port: int = SECURE_PORT
    revoked: str = ""
    routers: list[str] = field(default_factory=list)
    common: str = ""

    @property
    def common_name(self) -> str:
        """Name in its certificate."""
        return self.common or self.name


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
            raise UserError(
                f"{folder}: no authority, wanted --authority FOLDER of one; `triline keys new FOLDER` makes the first"
            ) from None
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
        routers: list[str] | None = None,
    ) -> Path:
        """Certify an aircraft, a router or a desk; returns its bundle.

        Parameters
        ----------
        name : of the aircraft (its platform) or the desk
        kind : `AIRCRAFT`, `ROUTER` or `DESK`
        hosts : where an aircraft or a router listens, or which aircraft a desk calls: addresses or host names
        port : on which the platform meets, or the router listens
        days : for which the certificate holds
        now : time of certification; None = that of this machine's clock
        routers : which routers it calls, ``host`` or ``host:port``

        Raises
        ------
        UserError : a name that is taken or cannot be one, a router without an address, hosts and routers of a desk,
            or a host, port or time that cannot be
        """
        _named(name)
        for host in hosts:
            _check_host(host)
        if not 0 < port < 65536:
            raise UserError(f"--port {port}: wanted 1 to 65535")
        if not 1 <= days <= LONGEST_DAYS:
            raise UserError(f"--days {days}: wanted 1 to {LONGEST_DAYS}")
        called = [_host_and_port(router) for router in routers or []]
        if kind == ROUTER and not hosts:
            raise UserError(f"{name}: wanted --host, the address at which the router listens")
        if kind == DESK and hosts and called:
            raise UserError(f"{name}: --host and --router: wanted one of them, a desk calls aircraft or routers")
        if name == self.name or any(member.name == name and not member.revoked for member in self.members):
            raise UserError(f"{name}: this name is taken in {self.folder}; revoke it first, or choose another")
        key = ec.generate_private_key(ec.SECP256R1())
        earlier = sum(member.name == name for member in self.members)  # all of them revoked
        common = f"{name}.{earlier + 1}" if earlier else name  # access lists know nothing else of a certificate
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])
        listens = ["127.0.0.1", "localhost", *(hosts if kind != DESK else [])]
        use = x509.KeyUsage(
            digital_signature=True, content_commitment=False, key_encipherment=False, data_encipherment=False,
            key_agreement=False, key_cert_sign=False, crl_sign=False, encipher_only=False, decipher_only=False,
        )  # fmt: skip
        identifier = x509.AuthorityKeyIdentifier.from_issuer_public_key(
            self._certificate.public_key()  # pyrefly: ignore[bad-argument-type]  # of an elliptic curve, as is the next
        )
        certificate = (
            _begun(subject, self._certificate.subject, key.public_key(), days, now)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(use, critical=True)
            .add_extension(x509.ExtendedKeyUsage(USES), critical=False)
            .add_extension(x509.SubjectAlternativeName([_alternative(host) for host in listens]), critical=False)
            .add_extension(identifier, critical=False)
            .sign(self._key, hashes.SHA256())  # pyrefly: ignore[bad-argument-type]
        )  # fmt: skip
        bundle = self.folder / name
        bundle.mkdir(exist_ok=True)
        os.chmod(bundle, 0o700)
        write_private(bundle / KEY, _pem(key))
        (bundle / CERTIFICATE).write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
        (bundle / AUTHORITY).write_bytes((self.folder / CERTIFICATE).read_bytes())
        until = certificate.not_valid_after_utc.date().isoformat()
        serial = f"{certificate.serial_number:x}"
        self.members.append(Certified(name, kind, serial, until, hosts, port, "", called, common if earlier else ""))
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
        lists = self._access_list(member) if member.kind != ROUTER else self._router_access_list()
        settings = zenoh_settings(bundle, member) | {"access_control": lists}
        _write_configuration(bundle / CONFIGURATION, member, settings)
        if member.kind == AIRCRAFT and member.routers:
            settings = ground_link_settings(bundle, member) | {"access_control": self._link_access_list(member)}
            _write_configuration(bundle / GROUND_LINK, member, settings)
        else:
            (bundle / GROUND_LINK).unlink(missing_ok=True)

    def _access_list(self, member: Certified) -> dict[str, Any]:
        """Who may send what to this member: all that is not allowed is dropped."""
        rules: list[dict[str, Any]] = [_rule("out", "egress", _MESSAGES, ["triline/**"])]
        subjects: list[dict[str, Any]] = [{"id": "everybody"}]
        policies = [{"rules": ["out"], "subjects": ["everybody"]}]
        for other in self.valid:
            if other.kind == AIRCRAFT:
                id = f"aircraft-{other.name}"
                rules.append(_rule(id, "ingress", _MESSAGES, [f"triline/{other.name}/**"]))
                subjects.append({"id": id, "cert_common_names": [other.common_name]})
                policies.append({"rules": [id], "subjects": [id]})
        self._let_desks(rules, subjects, policies)
        if member.kind == DESK and member.routers:
            self._let_routers(rules, subjects, policies)
        return _access(rules, subjects, policies)

    def _let_routers(self, rules: list[Any], subjects: list[Any], policies: list[Any], *more: str) -> None:
        """Let routers say what they have let in."""
        routers = [member.common_name for member in self.valid if member.kind == ROUTER]
        if routers:
            rules.append(_rule("routers", "ingress", _MESSAGES, ["triline/**"]))
            subjects.append({"id": "routers", "cert_common_names": routers})
            policies.append({"rules": ["routers", *more], "subjects": ["routers"]})

    def _let_desks(self, rules: list[Any], subjects: list[Any], policies: list[Any]) -> None:
        """Let desks read, and say what desks say."""
        desks = [member.common_name for member in self.valid if member.kind == DESK]
        if desks:
            rules.append(_rule("desk-reads", "ingress", _READING, ["triline/**"]))
            rules.append(_rule("desk-says", "ingress", ("put",), [f"triline/*/{topic}" for topic in DESK_TOPICS]))
            rules.append(
                _rule("desk-lives", "ingress", ("liveliness_token",), [f"triline/*/{key}" for key in _DESK_TOKENS])
            )
            subjects.append({"id": "desks", "cert_common_names": desks})
            policies.append({"rules": ["desk-reads", "desk-says", "desk-lives"], "subjects": ["desks"]})

    def _router_access_list(self) -> dict[str, Any]:
        """Who may send what to a router, and what the router sends to whom.

        An aircraft speaks for its platform and hears nothing of the others; routers hand on what they have let in.
        """
        rules = [_rule("asks", "egress", _ASKING, ["triline/**"]), _rule("tells", "egress", _SAYING, ["triline/**"])]
        subjects: list[dict[str, Any]] = [{"id": "everybody"}]
        policies = [{"rules": ["asks"], "subjects": ["everybody"]}]
        for member in self.valid:
            if member.kind == AIRCRAFT:
                id, own = f"aircraft-{member.name}", [f"triline/{member.name}/**"]
                rules += [_rule(id, "ingress", _MESSAGES, own), _rule(f"{id}-hears", "egress", _SAYING, own)]
                subjects.append({"id": id, "cert_common_names": [member.common_name]})
                policies.append({"rules": [id, f"{id}-hears"], "subjects": [id]})
        self._let_routers(rules, subjects, policies, "tells")
        self._let_desks(rules, subjects, policies)
        if any(member.kind == DESK for member in self.valid):
            policies.append({"rules": ["tells"], "subjects": ["desks"]})
        return _access(rules, subjects, policies)

    def _link_access_list(self, member: Certified) -> dict[str, Any]:
        """What an aircraft takes on its link to the ground: questions, and verdicts."""
        own = f"triline/{member.name}"
        routers = [other.common_name for other in self.valid if other.kind == ROUTER]
        rules = [_rule("out", "egress", _MESSAGES, ["triline/**"])]
        subjects: list[dict[str, Any]] = [{"id": "everybody"}]
        policies = [{"rules": ["out"], "subjects": ["everybody"]}]
        if routers:
            rules.append(_rule("ground-asks", "ingress", _ASKING, ["triline/**"]))
            rules.append(_rule("ground-says", "ingress", ("put",), [f"{own}/{topic}" for topic in UPLINK_TOPICS]))
            rules.append(_rule("ground-answers", "ingress", ("reply",), [f"{own}/query/**"]))
            subjects.append({"id": "routers", "cert_common_names": routers})
            policies.append({"rules": ["ground-asks", "ground-says", "ground-answers"], "subjects": ["routers"]})
        return _access(rules, subjects, policies)


def zenoh_settings(bundle: Path, member: Certified) -> dict[str, Any]:
    """Settings of Zenoh for encryption and where to listen and call, by their paths."""
    here = f"tls/127.0.0.1:{member.port}"
    routers = [f"tls/{router}" for router in member.routers]
    if member.kind == AIRCRAFT:
        listen = [here, *(f"tls/{_endpoint(host)}:{member.port}" for host in member.hosts)]
        listen += ["tls/127.0.0.1:0", *(f"tls/{_endpoint(host)}:0" for host in member.hosts)]
        return _settings(bundle, "peer", listen, [here])
    if member.kind == ROUTER:
        listen = [f"tls/{_endpoint(host)}:{member.port}" for host in dict.fromkeys((*member.hosts, "127.0.0.1"))]
        # an address of a link that is down comes later
        retry = {"period_init_ms": 500, "period_max_ms": 2000, "period_increase_factor": 1.5}
        own = {"listen/timeout_ms": -1, "listen/retry": retry, "transport/link/tx/lease": LEASE_MS}
        return _settings(bundle, "router", listen, routers) | own
    if routers:
        return _settings(bundle, "client", [], routers) | {"transport/link/tx/lease": LEASE_MS}
    return _settings(
        bundle, "peer", ["tls/127.0.0.1:0"], [f"tls/{_endpoint(host)}:{member.port}" for host in member.hosts] or [here]
    )


def ground_link_settings(bundle: Path, member: Certified) -> dict[str, Any]:
    """Settings of Zenoh for an aircraft's link to the routers on the ground: it calls, and nobody can call it."""
    return _settings(bundle, "client", [], [f"tls/{router}" for router in member.routers]) | {
        "transport/link/tx/lease": LEASE_MS,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": SLOW_US,
        "transport/link/tls/so_sndbuf": SOCKET_BYTES,
        "transport/link/tx/batch_size": BATCH_BYTES,
    }


def _settings(bundle: Path, mode: str, listen: list[str], connect: list[str]) -> dict[str, Any]:
    def file(name: str) -> str:
        return base64.b64encode((bundle / name).read_bytes()).decode()

    tls = "transport/link/tls"
    client = mode == "client"
    return {
        "mode": mode,
        "scouting/multicast/enabled": False,
        # who is told where others listen links with them directly, past the access list of the router
        "scouting/gossip/enabled": mode == "peer",
        "listen/endpoints": listen,
        "listen/timeout_ms": 0,
        "listen/exit_on_failure": False,
        "connect/endpoints": connect,
        # a client is not opened without a router; once it was linked, it calls again for ever
        "connect/timeout_ms": CALL_MS if client else -1,
        "connect/exit_on_failure": client,
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


def _write_configuration(path: Path, member: Certified, settings: dict[str, Any]) -> None:
    """Write settings by their paths as a Zenoh configuration."""
    tree: dict[str, Any] = {}
    for key, value in settings.items():
        *parents, last = key.split("/")
        place = tree
        for parent in parents:
            place = place.setdefault(parent, {})
        place[last] = value
    head = f"// Zenoh for {member.kind} {member.name}, by `triline keys`. It holds a private key: keep it secret.\n"
    write_private(path, (head + json.dumps(tree, indent=2) + "\n").encode())


def _access(rules: list[Any], subjects: list[Any], policies: list[Any]) -> dict[str, Any]:
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects,
            "policies": policies}  # fmt: skip


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


def _check_host(host: str) -> None:
    """Raise UserError for what is neither an address nor a host name."""
    if not re.fullmatch(r"[A-Za-z0-9._-]+", host):
        try:
            ipaddress.ip_address(host)
        except ValueError:
            raise UserError(f"--host {host!r}: wanted an address or the name of a host, without a port") from None


def _host_and_port(router: str) -> str:
    """``host:port`` of a router, an IPv6 address in brackets.

    Raises
    ------
    UserError : neither ``host`` nor ``host:port``
    """
    found = re.fullmatch(r"(\[[0-9A-Fa-f:]+\]|[A-Za-z0-9._-]+)(?::(\d{1,5}))?", router)
    if not found or not 0 < int(found[2] or SECURE_PORT) < 65536:
        raise UserError(f"--router {router!r}: wanted HOST or HOST:PORT")
    return f"{found[1]}:{found[2] or SECURE_PORT}"


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
