"""Certificates as an independent verifier sees them."""

from __future__ import annotations

import datetime
import ipaddress

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from cryptography.x509.verification import PolicyBuilder, Store, VerificationError

from koop_clients.pki.certificates import (
    AUTHORITY_DAYS,
    DAYS,
    Identity,
    expiry_of,
    make_authority,
    make_client,
    make_server,
    read_identity,
    server_names,
)

NOW = datetime.datetime(2026, 5, 1, 12, tzinfo=datetime.UTC)
DAY = datetime.timedelta(days=1)


@pytest.fixture(scope="module")
def authority() -> Identity:
    return make_authority(NOW)


def policy(authority: Identity, at: datetime.datetime) -> PolicyBuilder:
    return PolicyBuilder().store(Store([authority.certificate])).time(at)


def test_a_server_is_verified_by_each_of_its_names_and_no_other(authority: Identity) -> None:
    server = make_server(authority, ["koop.example", "10.0.0.7", "::1"], NOW)
    names = [x509.DNSName("koop.example")]
    names += [x509.IPAddress(ipaddress.ip_address(a)) for a in ("10.0.0.7", "::1")]
    for name in names:
        verifier = policy(authority, NOW).build_server_verifier(name)
        assert len(verifier.verify(server.certificate, [])) == 2
    other = policy(authority, NOW).build_server_verifier(x509.DNSName("other.example"))
    with pytest.raises(VerificationError):
        other.verify(server.certificate, [])
    assert server_names(server.certificate_pem) == ["koop.example", "10.0.0.7", "::1"]


def test_purposes_are_kept_apart(authority: Identity) -> None:
    """A client's certificate is no server's, and the other way about; neither may sign."""
    server, client = make_server(authority, ["a"], NOW), make_client(authority, "a", NOW)
    purposes = {}
    for identity in (server, client):
        extensions = identity.certificate.extensions
        usage = extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        purposes[identity] = list(usage)
        assert extensions.get_extension_for_class(x509.BasicConstraints).value.ca is False
        assert not extensions.get_extension_for_class(x509.KeyUsage).value.key_cert_sign
    assert purposes[server] == [ExtendedKeyUsageOID.SERVER_AUTH]
    assert purposes[client] == [ExtendedKeyUsageOID.CLIENT_AUTH]


def test_a_client_is_known_by_its_common_name(authority: Identity) -> None:
    client = make_client(authority, "robot7", NOW)
    (name,) = client.certificate.subject
    assert (name.oid, name.value) == (NameOID.COMMON_NAME, "robot7")


def test_validity_begins_before_now_for_slow_clocks_and_ends_as_told(authority: Identity) -> None:
    client = make_client(authority, "robot7", NOW, days=7)
    begin = client.certificate.not_valid_before_utc
    assert NOW - DAY < begin < NOW - datetime.timedelta(minutes=5)
    assert expiry_of(client.certificate_pem) == NOW + 7 * DAY
    assert expiry_of(make_client(authority, "robot7", NOW).certificate_pem) == NOW + DAYS * DAY
    assert expiry_of(authority.certificate_pem) == NOW + AUTHORITY_DAYS * DAY


@pytest.mark.parametrize("days", [0, -1, AUTHORITY_DAYS + 1, float("nan")])
def test_a_certificate_does_not_outlive_its_authority(authority: Identity, days: float) -> None:
    with pytest.raises(ValueError, match="no end after that of the authority, 2036-04-28"):
        make_client(authority, "robot7", NOW, days)


def test_authorities_have_names_of_their_own() -> None:
    names = {make_authority(NOW).certificate.subject.rfc4514_string() for _ in range(5)}
    assert len(names) == 5


def test_an_identity_survives_its_files(authority: Identity) -> None:
    again = read_identity(authority.certificate_pem, authority.key_pem)
    assert again.certificate == authority.certificate
    assert again.key_pem == authority.key_pem
    assert b"BEGIN PRIVATE KEY" in authority.key_pem  # PKCS#8


def test_a_hub_needs_a_name(authority: Identity) -> None:
    with pytest.raises(ValueError, match="the hub has no name"):
        make_server(authority, [], NOW)
