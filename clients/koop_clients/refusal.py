"""Why a hub that is there does not let a client in. Zenoh says only that it could not connect.

After a failed attempt the handshake is tried once more with Python's own TLS, whose errors tell
what was wrong. Only what cannot pass by itself counts as a refusal.
"""

from __future__ import annotations

import socket
import ssl
from dataclasses import dataclass
from pathlib import Path

_TIMEOUT = 3.0  # s, for each step
_PLAIN_TIMEOUT = 1.0  # s, for a hub to show that it speaks TLS
_LAST_WORD = 1.0  # s; a TLS 1.3 server judges the client's certificate after the handshake

# Verification errors of OpenSSL, by number (x509_vfy.h).
_NOT_YET_VALID, _EXPIRED, _PURPOSE = 9, 10, 26
_UNKNOWN_ISSUER, _WRONG_NAME = {18, 19, 20, 21}, {62, 64}


@dataclass(frozen=True)
class Credentials:
    """The files that a TLS session is opened with.

    Attributes:
        authority: certificates of those who may sign the hub's; None: those that the system trusts.
        certificate: the client's own, if it has one.
        key: its private key.
        verifies_name: whether the hub's certificate must be for the name that it is reached by.
    """

    authority: Path | None = None
    certificate: Path | None = None
    key: Path | None = None
    verifies_name: bool = True

    def context(self) -> ssl.SSLContext:
        """For a handshake as a client. Raises ValueError for files that cannot be used."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname = self.verifies_name
        try:
            if self.authority is None:
                context.load_default_certs()
            else:
                context.load_verify_locations(self.authority)
            if self.certificate is not None:
                # Without a password OpenSSL would ask for one on the terminal.
                context.load_cert_chain(self.certificate, self.key, password="")
        except OSError as error:
            files = ", ".join(str(f) for f in (self.authority, self.certificate, self.key) if f)
            raise ValueError(
                f"{files} cannot be used together: {error}; expected PEM files of an authority, "
                "of a certificate and of its key, not encrypted"
            ) from error
        return context


def is_listening(endpoint: str) -> bool:
    """Whether anybody accepts a connection at a tcp or tls endpoint."""
    address = _address(endpoint)
    if address is None:
        return False
    try:
        socket.create_connection(address, timeout=_TIMEOUT).close()
    except OSError:
        return False
    return True


def why_refused(endpoint: str, credentials: Credentials) -> str | None:
    """What stands between the client and the hub, in words that follow "... is there, but".

    None where nobody listens, or where it may pass by itself.

    Raises:
        ValueError: the credentials cannot be used.
    """
    address = _address(endpoint)
    if address is None or not is_listening(endpoint):
        return None
    if endpoint.startswith("tcp/"):
        return _PLAIN if _speaks_tls(address) else None
    try:
        _shake_hands(address, credentials.context())
    except ssl.SSLCertVerificationError as error:
        return _fault_of_hub(error, address[0], credentials)
    except ssl.SSLError as error:
        return _answer_of_hub(error, credentials)
    except OSError:
        return None
    return None


_PLAIN = (
    "takes TLS only; connect with a certificate: --zenoh-config FILE, or "
    "open_session(config_file=FILE)"
)


def _fault_of_hub(error: ssl.SSLCertVerificationError, host: str, credentials: Credentials) -> str:
    """What is wrong with the hub's certificate."""
    code = error.verify_code
    if code in _WRONG_NAME:
        return (
            f"its certificate is not for {host}; connect to a name that it is for, or give it "
            "this one (koop-pki init --server)"
        )
    if code in _UNKNOWN_ISSUER and credentials.authority is None:
        return (
            "its certificate is not from an authority that this machine trusts; name the hub's "
            "own: --zenoh-config FILE, with root_ca_certificate"
        )
    if code in _UNKNOWN_ISSUER:
        return (
            f"its certificate is not from the authority in {credentials.authority}: it is another "
            "hub, or the file is of another deployment"
        )
    if code == _EXPIRED:
        return "its certificate has expired; make a new one (koop-pki renew hub) and restart it"
    if code == _NOT_YET_VALID:
        return "its certificate is not valid yet; is the clock of this machine right?"
    if code == _PURPOSE:
        return "its certificate is not a hub's, but somebody's who passes for it"
    return f"its certificate is not good: {error.verify_message}"


def _answer_of_hub(error: ssl.SSLError, credentials: Credentials) -> str | None:
    """What the hub says against us; None where it said nothing."""
    mine, reason = credentials.certificate, error.reason or ""
    if "CERTIFICATE_REQUIRED" in reason:
        return "asks for a certificate, and this client shows none; give it one: --zenoh-config"
    if "UNKNOWN_CA" in reason:
        return f"does not know the authority that signed {mine}: it is of another deployment"
    if "CERTIFICATE_EXPIRED" in reason:
        return (
            f"finds that {mine} has expired, or is not valid yet; renew it (koop-pki renew), or "
            "set the clock"
        )
    if "CERTIFICATE" in reason or "ACCESS_DENIED" in reason:
        return f"does not take {mine} as the certificate of a client: {reason.lower()}"
    # Who closes a link whose first bytes it does not understand may do so in either way.
    if "WRONG_VERSION" in reason or "EOF" in reason or isinstance(error, ssl.SSLZeroReturnError):
        return "does not speak TLS; connect with tcp/ in place of tls/ if that is what you want"
    return f"breaks the handshake off: {reason.lower() or error}"


def _shake_hands(address: tuple[str, int], context: ssl.SSLContext) -> None:
    """A whole handshake, and the wait for a word against it."""
    with (
        socket.create_connection(address, timeout=_TIMEOUT) as plain,
        context.wrap_socket(plain, server_hostname=address[0]) as link,
    ):
        link.settimeout(_LAST_WORD)
        link.recv(1)


def _speaks_tls(address: tuple[str, int]) -> bool:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        with (
            socket.create_connection(address, timeout=_PLAIN_TIMEOUT) as plain,
            context.wrap_socket(plain),
        ):
            return True
    except OSError:
        return False


def _address(endpoint: str) -> tuple[str, int] | None:
    """Host and port of a tcp or tls endpoint; None for others."""
    protocol, _, rest = endpoint.partition("/")
    host, _, port = rest.partition("#")[0].partition("?")[0].rpartition(":")
    if protocol not in ("tcp", "tls") or not port.isdecimal():
        return None
    return host.strip("[]"), int(port)
