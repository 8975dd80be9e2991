"""A certificate that this machine signs itself: live cameras need https, and no authority signs for a home network."""

import datetime
import ipaddress
import os
import socket
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from capture.files.atomic import atomic_file

DAYS = 30
PRIVATE = 0o600


def make_certificate(folder: Path, addresses: list[str]) -> tuple[Path, Path]:
    """Write a new certificate and its key for these addresses and this machine's names; return both paths.

    Raises:
        OSError: they cannot be written.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    now = datetime.datetime.now(datetime.UTC)
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "Shadowgraph studio on this network")])
    hosts = [x509.DNSName(host) for host in dict.fromkeys(["localhost", _plain(socket.gethostname())]) if host]
    places = [x509.IPAddress(ipaddress.ip_address(one)) for one in dict.fromkeys(["127.0.0.1", *addresses])]
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=DAYS))
        .add_extension(x509.SubjectAlternativeName([*hosts, *places]), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .sign(key, hashes.SHA256())
    )
    secret = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    folder.mkdir(parents=True, exist_ok=True)
    for path, content in ((folder / "key.pem", secret), (folder / "certificate.pem", _pem(certificate))):
        with atomic_file(path) as temporary:
            temporary.touch(PRIVATE)
            temporary.write_bytes(content)
        os.chmod(path, PRIVATE)
    return folder / "certificate.pem", folder / "key.pem"


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _plain(host: str) -> str:
    """Return a host's name if a certificate can hold it, else nothing."""
    return host if host.isascii() and 0 < len(host) < 64 else ""
