"""The garden's certificate authority: what `garden init` makes so that TLS is one setting away.

ECDSA on P-256 and not the nodes' Ed25519, which browsers and small TLS libraries do not take in certificates.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from urllib.parse import quote

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric.ec import SECP256R1, EllipticCurvePrivateKey, generate_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from core.errors import ConfigError
from core.mesh import keyfiles
from core.mesh.auth import Enrolled, GardenKey, audience
from core.mesh.tls import AUTHORITY, CERTIFICATE, KEY

AUTHORITY_LIFE = timedelta(days=3650)
LIFE = timedelta(days=365)
RENEWED_BEFORE = timedelta(days=30)
"""A certificate with less than this left is made anew."""
EARLIER = timedelta(days=1)
"""Certificates hold from before they were made: nodes' clocks differ."""
AUTHORITY_KEY = "ca.key"
_HOST = re.compile(r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?", re.IGNORECASE)
_LOOPBACK = ("127.0.0.1", "::1")


def certify(folder: Path, nodes: Iterable[Enrolled], now: datetime) -> list[str]:
    """Make whatever certificates are missing or about to expire below `folder`, and tell whose. Never replaces a key.

    Files: `ca.key` (0600) and `ca.crt`; for every node `ID/{tls.key,tls.crt,ca.crt}`; for `operator` and `viewer`, who need
    none of their own, `ca.crt`. Call after `make_garden`. `now` is Unix time with its zone: certificates know no other.
    Raises ConfigError for files that hold something else.
    """
    made: list[str] = []
    garden = audience(GardenKey.load(folder / "garden.key").public())
    authority, is_new = _authority(folder, garden, now)
    made += [AUTHORITY] if is_new else []
    pem = authority.certificate.public_bytes(serialization.Encoding.PEM)
    for node in nodes:
        if authority.enrol(folder / node.id, node, now):
            made.append(node.id)
    for holder in (*(path.parent for path in folder.glob(f"*/{CERTIFICATE}")), folder / "operator", folder / "viewer"):
        keyfiles.write(holder / AUTHORITY, pem, mode=0o644)
    return made


@dataclass(frozen=True, slots=True)
class Authority:
    """Who signs."""

    garden: str
    """The trust domain: the garden's name on its tokens."""
    key: EllipticCurvePrivateKey
    certificate: x509.Certificate

    def enrol(self, folder: Path, node: Enrolled, now: datetime) -> bool:
        """True when the node had no certificate of ours that still holds for a while."""
        path = folder / CERTIFICATE
        folder.mkdir(exist_ok=True, mode=0o755)
        key = _key(folder / KEY)
        if path.exists() and self._holds(path, key, now):
            return False
        certificate = self._issue(node, key, now)
        keyfiles.write(path, certificate.public_bytes(serialization.Encoding.PEM), mode=0o644)
        return True

    def _holds(self, path: Path, key: EllipticCurvePrivateKey, now: datetime) -> bool:
        certificate = _certificate(path)
        try:
            certificate.verify_directly_issued_by(self.certificate)
        except (ValueError, InvalidSignature):
            return False
        left = certificate.not_valid_after_utc - now
        return left > RENEWED_BEFORE and certificate.public_key() == key.public_key()

    def _issue(self, node: Enrolled, key: EllipticCurvePrivateKey, now: datetime) -> x509.Certificate:
        names: list[x509.GeneralName] = [
            x509.UniformResourceIdentifier(f"spiffe://{self.garden}/{node.role}/{quote(node.id, safe='/')}")
        ]
        names += [x509.DNSName(host) for host in (node.id, "localhost") if _HOST.fullmatch(host)]
        names += [x509.IPAddress(ipaddress.ip_address(address)) for address in _LOOPBACK]
        usage = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        until = min(now + LIFE, self.certificate.not_valid_after_utc)
        return (
            _builder(node.id, self.certificate.subject, key, now, until)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_key_usage(signs_certificates=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(usage), critical=False)
            .add_extension(x509.SubjectAlternativeName(names), critical=False)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(self.key.public_key()), critical=False)
            .sign(self.key, hashes.SHA256())
        )


def _authority(folder: Path, garden: str, now: datetime) -> tuple[Authority, bool]:
    """The garden's, and whether it had none before."""
    path = folder / AUTHORITY
    key = _key(folder / AUTHORITY_KEY)
    if path.exists():
        certificate = _certificate(path)
        if certificate.public_key() == key.public_key() and certificate.not_valid_after_utc - now > RENEWED_BEFORE:
            return Authority(garden, key, certificate), False
    name = _named(garden)
    certificate = (
        _builder(garden, name, key, now, now + AUTHORITY_LIFE)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_key_usage(signs_certificates=True), critical=True)
        .sign(key, hashes.SHA256())
    )
    keyfiles.write(path, certificate.public_bytes(serialization.Encoding.PEM), mode=0o644)
    return Authority(garden, key, certificate), True


def _builder(
    name: str, issuer: x509.Name, key: EllipticCurvePrivateKey, now: datetime, until: datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(_named(name))
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - EARLIER)
        .not_valid_after(until)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _named(name: str) -> x509.Name:
    """X.520 allows 64 characters; the whole name stands in the URI."""
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name[:64])])


def _key_usage(signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates, key_cert_sign=signs_certificates, crl_sign=signs_certificates,
        content_commitment=False, key_encipherment=False, data_encipherment=False, key_agreement=False,
        encipher_only=False, decipher_only=False,
    )  # fmt: skip


def _key(path: Path) -> EllipticCurvePrivateKey:
    """The file's, made if it is missing."""
    if not path.exists():
        keyfiles.write(path, keyfiles.private_pem(generate_private_key(SECP256R1())))
    try:
        key = serialization.load_pem_private_key(keyfiles.read(path), password=None)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{path} holds no key", hint="move it away and run `garden init`") from error
    if not isinstance(key, EllipticCurvePrivateKey):
        raise ConfigError(f"{path} is no ECDSA key", hint="move it away and run `garden init`")
    return key


def _certificate(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(keyfiles.read(path))
    except ValueError as error:
        raise ConfigError(f"{path} holds no certificate", hint="move it away and run `garden init`") from error
