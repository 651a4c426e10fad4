"""Signed recordings: what of a recording was altered after it was made, and who made it.

Beside the recording stands a seal, ``NAME.mcap.seal``, of JSON lines. The first names the recording and holds the
certificate of who signs, with that of its authority. Each of the others covers the bytes since the one before it (a
chunk, as a rule): up to where, the hash of ``hash before | bytes``, and its signature (ECDSA over SHA-256). Since every
hash holds all before it, nothing can be taken out, put in or exchanged; the last line says that the recording was
closed, and covers its index. A recorder that was killed leaves a seal of what had been written.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from ..errors import UserError
from .seal_place import seal_of

#: Of a seal so much is read at most, bytes, and of the recording at a time.
LARGEST, AT_A_TIME = 1 << 28, 1 << 22
_VERSION = 1


class Seal:
    """Signs a recording while it is written.

    Parameters
    ----------
    recording : its path
    certificate, authority, key : PEM files: of who signs, of who certified that, and the private key

    Raises
    ------
    OSError : the seal cannot be written
    ValueError : the key is none of an elliptic curve
    """

    def __init__(self, recording: Path, certificate: Path, authority: Path, key: Path) -> None:
        private = serialization.load_pem_private_key(key.read_bytes(), None)
        if not isinstance(private, ec.EllipticCurvePrivateKey):
            raise ValueError(f"{key}: wanted a key of an elliptic curve")
        self._key = private
        self._file = open(seal_of(recording), "w", encoding="ascii")  # noqa: SIM115  # closed by close
        head = {
            "triline_seal": _VERSION,
            "recording": recording.name,
            "certificate": certificate.read_text(encoding="ascii"),
            "authority": authority.read_text(encoding="ascii"),
        }
        line = json.dumps(head)
        self._hash = hashlib.sha256(line.encode())
        self._to = self._signed = 0
        self._write(line)

    def took(self, data: bytes | memoryview) -> None:
        """Bytes have been written at the end of the recording."""
        self._hash.update(data)
        self._to += len(data)

    def sign(self, closed: bool = False) -> None:
        """Sign what has been written since the last signature."""
        if self._to == self._signed and not closed:
            return
        digest = _digest(self._hash, self._to, closed)
        signature = base64.b64encode(self._key.sign(digest, ec.ECDSA(hashes.SHA256()))).decode()
        self._write(json.dumps({"to": self._to, "closed": closed, "hash": digest.hex(), "signature": signature}))
        self._hash = hashlib.sha256(digest)
        self._signed = self._to

    def close(self) -> None:
        """The recording is complete."""
        self.sign(closed=True)
        self._file.close()

    def _write(self, line: str) -> None:
        self._file.write(line + "\n")
        self._file.flush()


def _digest(state: Any, to: int, closed: bool) -> bytes:
    end = state.copy()
    end.update(f"|{to}|{closed}".encode())
    return end.digest()


@dataclass(frozen=True)
class Verdict:
    """What a seal says of a recording.

    Attributes
    ----------
    signer, authority : names in the certificates
    fingerprint : SHA-256 of the authority's certificate, the first 16 hexadecimal digits
    signatures : how many
    altered : what is not as it was signed, one line each; none if all is
    """

    signer: str
    authority: str
    fingerprint: str
    signatures: int
    altered: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return f"signed by {self.signer!r} of {self.authority!r} ({self.fingerprint}), {self.signatures} signatures"


def verify(recording: Path, authority: Path | None = None) -> Verdict | None:
    """Compare a recording with its seal; None where there is no seal.

    Parameters
    ----------
    authority : certificate (PEM) of the authority that must have certified who signed

    Raises
    ------
    UserError : the seal is none, or is not of that authority
    """
    path = seal_of(recording)
    if not path.is_file():
        return None
    if path.stat().st_size > LARGEST:
        raise UserError(f"{path}: {path.stat().st_size} bytes are no seal")
    lines = path.read_bytes().split(b"\n")
    try:
        head = json.loads(lines[0])
        if head["triline_seal"] != _VERSION:
            raise UserError(f"{path}: version {head['triline_seal']} of a seal, wanted {_VERSION}")
        certificate = x509.load_pem_x509_certificate(head["certificate"].encode())
        issuer = x509.load_pem_x509_certificate(head["authority"].encode())
        key = certificate.public_key()
        signer, name = (
            str(c.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value) for c in (certificate, issuer)
        )
        if not isinstance(key, ec.EllipticCurvePublicKey):
            raise ValueError("no elliptic curve")
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError):
        raise UserError(f"{path}: not readable, wanted a seal as `[recorder] sign` writes it") from None
    try:
        certificate.verify_directly_issued_by(issuer)
    except (ValueError, TypeError, InvalidSignature):
        raise UserError(f"{path}: the certificate of {signer!r} is not of {name!r}, whose name it has") from None
    wanted = issuer if authority is None else _certificate(authority)
    if wanted.fingerprint(hashes.SHA256()) != issuer.fingerprint(hashes.SHA256()):
        raise UserError(f"{path}: signed by {signer!r} of {name!r}, which is another authority than {authority}")
    altered = list(_compare(recording, lines, key))
    fingerprint = issuer.fingerprint(hashes.SHA256()).hex()[:16]
    return Verdict(signer, name, fingerprint, max(0, sum(bool(line) for line in lines[1:])), altered)


def _certificate(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except (OSError, ValueError):
        raise UserError(f"{path}: wanted the certificate (PEM) of an authority") from None


def _compare(recording: Path, lines: list[bytes], key: ec.EllipticCurvePublicKey) -> Iterator[str]:
    """What of a recording is not as it was signed."""
    size, place, closed = recording.stat().st_size, 0, False
    state = hashlib.sha256(lines[0])
    with open(recording, "rb") as file:
        for number, line in enumerate(filter(None, lines[1:]), 1):
            try:
                row = json.loads(line)
                to, closed, told = int(row["to"]), row["closed"] is True, bytes.fromhex(row["hash"])
                signature = base64.b64decode(row["signature"], validate=True)
                key.verify(signature, told, ec.ECDSA(hashes.SHA256()))
            except (ValueError, KeyError, TypeError, RecursionError, OverflowError, InvalidSignature):
                yield f"signature {number} of the seal, of bytes from {place} on, is not of who signed the others"
                return
            if to < place:
                yield f"signature {number} of the seal is out of order"
                return
            left = min(to, size) - place
            while left > 0:
                data = file.read(min(left, AT_A_TIME))
                state.update(data)
                left -= len(data)
                if not data:
                    break
            if to > size:
                yield f"cut off: {to} bytes were signed, {size} are there"
                return
            if _digest(state, to, closed) != told:
                yield f"bytes {place} to {to} were altered after they were signed, or a signature was taken out"
            state = hashlib.sha256(told)  # what follows is judged by what was signed
            place = to
    if place < size:
        yield f"{size - place} bytes from {place} on are not signed"
    elif not closed:
        yield "the seal has no end: the recorder was killed, or the end was taken off"
