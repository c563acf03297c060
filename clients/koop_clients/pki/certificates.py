"""Keys and X.509 certificates: an authority, the hub's certificate, and those of the parties.

Made for what Zenoh's TLS (rustls) asks for: alternative names in a server's certificate, and keys
that are not encrypted. An extended key usage in each certificate keeps a party from passing for the
hub.
"""

from __future__ import annotations

import datetime
import ipaddress
import re
from collections.abc import Iterable
from dataclasses import dataclass

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric.ec import (
    SECP256R1,
    EllipticCurvePrivateKey,
    generate_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

AUTHORITY_DAYS = 3650
"""How long an authority is valid [d]."""
DAYS = 365
"""How long the other certificates are valid [d]."""

_HOST = re.compile(r"[A-Za-z0-9_-]{1,63}(?:\.[A-Za-z0-9_-]{1,63})*", re.ASCII)
_SKEW = datetime.timedelta(minutes=10)
"""By how much the clocks of robots may be behind."""


@dataclass(frozen=True)
class Identity:
    """A certificate and its private key."""

    certificate: x509.Certificate
    key: EllipticCurvePrivateKey

    @property
    def certificate_pem(self) -> bytes:
        """PEM of the certificate."""
        return self.certificate.public_bytes(serialization.Encoding.PEM)

    @property
    def key_pem(self) -> bytes:
        """PEM of the key, not encrypted: Zenoh takes no other."""
        return self.key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )


def make_authority(now: datetime.datetime) -> Identity:
    """A self-signed authority with a name of its own, valid for ten years."""
    key = generate_private_key(SECP256R1())
    serial = x509.random_serial_number()
    name = _name(f"koop authority {serial % 2**32:08x}")
    usage = _key_usage(key_cert_sign=True, crl_sign=True)
    builder = (
        _builder(name, name, key, serial, now, AUTHORITY_DAYS)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
    )
    return Identity(builder.sign(key, hashes.SHA256()), key)


def make_server(
    authority: Identity, names: Iterable[str], now: datetime.datetime, days: float = DAYS
) -> Identity:
    """The hub's certificate, for the host names and IP addresses that leaves connect to.

    Raises ValueError where there is no name, or one that no certificate can have.
    """
    names = list(names)
    if not names:
        raise ValueError("the hub has no name; give the host names that leaves connect to")
    alternatives = x509.SubjectAlternativeName([_alternative(name) for name in names])
    return _issue(authority, "koop hub", ExtendedKeyUsageOID.SERVER_AUTH, alternatives, now, days)


def make_client(
    authority: Identity, name: str, now: datetime.datetime, days: float = DAYS
) -> Identity:
    """A party's certificate, with its name as the common name."""
    return _issue(authority, name, ExtendedKeyUsageOID.CLIENT_AUTH, None, now, days)


def read_identity(certificate: bytes, key: bytes) -> Identity:
    """An identity out of its two PEMs. Raises ValueError where they are none."""
    private = serialization.load_pem_private_key(key, password=None)
    if not isinstance(private, EllipticCurvePrivateKey):
        raise ValueError("the key is not one of an elliptic curve, as koop-pki makes them")
    return Identity(x509.load_pem_x509_certificate(certificate), private)


def expiry_of(certificate: bytes) -> datetime.datetime:
    """When the (first) certificate in a PEM expires, in UTC."""
    return x509.load_pem_x509_certificate(certificate).not_valid_after_utc


def server_names(certificate: bytes) -> list[str]:
    """The host names and IP addresses that a hub's certificate is for."""
    found = x509.load_pem_x509_certificate(certificate).extensions.get_extension_for_class(
        x509.SubjectAlternativeName
    )
    return [str(name.value) for name in found.value]


def check_host(name: str) -> None:
    """Raise ValueError unless `name` is a host's name or an IP address."""
    if _HOST.fullmatch(name) is None and not _is_address(name):
        raise ValueError(
            f"{name!r} is no host; expected a name such as koop.example, in ASCII, or an address"
        )


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _issue(
    authority: Identity,
    name: str,
    purpose: x509.ObjectIdentifier,
    alternatives: x509.SubjectAlternativeName | None,
    now: datetime.datetime,
    days: float,
) -> Identity:
    _check_days(authority, now, days)
    key = generate_private_key(SECP256R1())
    issuer, serial = authority.certificate.subject, x509.random_serial_number()
    signer = x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key())
    builder = (
        _builder(_name(name), issuer, key, serial, now, days)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_key_usage(digital_signature=True), critical=True)
        .add_extension(x509.ExtendedKeyUsage([purpose]), critical=False)
        .add_extension(signer, critical=False)
    )
    if alternatives is not None:
        builder = builder.add_extension(alternatives, critical=False)
    return Identity(builder.sign(authority.key, hashes.SHA256()), key)


def _check_days(authority: Identity, now: datetime.datetime, days: float) -> None:
    end = authority.certificate.not_valid_after_utc
    if not 0 < days <= (end - now).total_seconds() / 86400:
        raise ValueError(
            f"a certificate cannot be valid for {days:g} days; expected more than 0, and no end "
            f"after that of the authority, {end:%Y-%m-%d}"
        )


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: EllipticCurvePrivateKey,
    serial: int,
    now: datetime.datetime,
    days: float,
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(serial)
        .not_valid_before(now - _SKEW)
        .not_valid_after(now + datetime.timedelta(days=days))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _alternative(name: str) -> x509.GeneralName:
    check_host(name)
    if _is_address(name):
        return x509.IPAddress(ipaddress.ip_address(name))
    return x509.DNSName(name)


def _key_usage(**given: bool) -> x509.KeyUsage:
    usages = (
        "digital_signature",
        "content_commitment",
        "key_encipherment",
        "data_encipherment",
        "key_agreement",
        "key_cert_sign",
        "crl_sign",
        "encipher_only",
        "decipher_only",
    )
    return x509.KeyUsage(**{usage: given.get(usage, False) for usage in usages})
