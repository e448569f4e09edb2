"""Makes the certificates of the ground link: one authority, one certificate per machine.

    make_authority(folder, now=now)
    make_certificate(folder, "drone1", hosts=["192.168.1.7"], now=now)  # a vehicle: what ground stations dial
    make_certificate(folder, "laptop", now=now)  # a ground station

Needs the package `cryptography`; a machine that only uses certificates does not.
"""

from __future__ import annotations

import ipaddress
import os
import re
from collections.abc import Sequence
from datetime import datetime, timedelta
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from companion.core.errors import InputError
from companion.runtime.bus.certificate_files import AUTHORITY

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey

AUTHORITY_DAYS, CERTIFICATE_DAYS, MOST_DAYS = 3650, 365, 36500
SKEW = timedelta(hours=1)  # clocks differ
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")
_HOST = re.compile(r"(?!-)[A-Za-z0-9-]{1,63}(?<!-)(\.(?!-)[A-Za-z0-9-]{1,63}(?<!-))*")


def make_authority(folder: Path, *, now: datetime, days: int = AUTHORITY_DAYS, force: bool = False) -> Path:
    """Write `ca.key` (mode 0600) and `ca.crt`; returns the certificate's path. `now` is in UTC."""
    _need_cryptography()
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "Understory ground link")])
    builder = (
        _builder(name, name, key, now, _end(now, days))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs_certificates=True), critical=True)
    )
    folder.mkdir(parents=True, exist_ok=True)
    return _write_pair(folder, AUTHORITY, key, builder.sign(key, hashes.SHA256()), force=force)


def make_certificate(
    folder: Path,
    name: str,
    *,
    now: datetime,
    hosts: Sequence[str] = (),
    days: int = CERTIFICATE_DAYS,
    force: bool = False,
) -> Path:
    """Write NAME.key (mode 0600) and NAME.crt, signed by the folder's authority; returns the certificate's path.

    With `hosts` (names or addresses by which it is dialled) it is a vehicle's, without a ground station's:
    neither can stand in for the other.
    """
    _need_cryptography()
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec

    if not _NAME.fullmatch(name) or name == AUTHORITY:
        raise InputError(f"{name!r} is no name for a certificate", field="NAME", valid="letters, digits, . _ -; not ca")
    signer, signer_key = _authority(folder)
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    role = x509.oid.ExtendedKeyUsageOID.SERVER_AUTH if hosts else x509.oid.ExtendedKeyUsageOID.CLIENT_AUTH
    end = min(_end(now, days), signer.not_valid_after_utc)
    builder = (
        _builder(subject, signer.subject, key, now, end)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage([role]), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signer_key.public_key()), critical=False)
        .add_extension(x509.SubjectAlternativeName([_host(h) for h in hosts or [name]]), critical=False)
    )
    return _write_pair(folder, name, key, builder.sign(signer_key, hashes.SHA256()), force=force)


def describe_certificate(path: Path) -> str:
    """Whose it is, by which names it is dialled, and until when it holds; '' if `cryptography` is not installed."""
    if find_spec("cryptography") is None:
        return ""
    from cryptography import x509

    try:
        certificate = x509.load_pem_x509_certificate(path.read_bytes())
        use = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        serves = x509.oid.ExtendedKeyUsageOID.SERVER_AUTH in use
    except x509.ExtensionNotFound:
        serves = False
    hosts = f", dialled as {', '.join(_hosts_of(certificate))}" if serves else ""
    common = certificate.subject.rfc4514_string().removeprefix("CN=")
    return f"{common}{hosts}, until {certificate.not_valid_after_utc:%Y-%m-%d}"


def _hosts_of(certificate: x509.Certificate) -> list[str]:
    from cryptography import x509

    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    return [str(n.value) for n in names]


def _need_cryptography() -> None:
    if find_spec("cryptography") is None:
        raise InputError(
            "making certificates needs the package cryptography: run `python -m pip install 'understory[ground]'`"
        )


def _authority(folder: Path) -> tuple[x509.Certificate, EllipticCurvePrivateKey]:
    from cryptography import x509
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    try:
        certificate = x509.load_pem_x509_certificate((folder / f"{AUTHORITY}.crt").read_bytes())
        key = serialization.load_pem_private_key((folder / f"{AUTHORITY}.key").read_bytes(), None)
    except OSError as error:
        problem = f"holds no authority ({error.strerror}): make one with `companion keys ca {folder}`"
        raise InputError(problem, file=str(folder)) from error
    except ValueError as error:
        raise InputError("holds an authority that cannot be read", file=str(folder)) from error
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        raise InputError("ca.key does not belong to ca.crt", file=str(folder))
    return certificate, key


def _builder(
    subject: x509.Name, issuer: x509.Name, key: EllipticCurvePrivateKey, now: datetime, end: datetime
) -> x509.CertificateBuilder:
    from cryptography import x509

    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(now, end - timedelta(seconds=1)) - SKEW)
        .not_valid_after(end)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    from cryptography import x509

    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _host(text: str) -> x509.GeneralName:
    from cryptography import x509

    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        if not _HOST.fullmatch(text.replace("_", "-")):
            raise InputError(f"{text!r} is no host", field="--host", valid="an IP address or a DNS name") from None
        return x509.DNSName(text)


def _end(now: datetime, days: int) -> datetime:
    if not 1 <= days <= MOST_DAYS:
        raise InputError(f"{days} days", field="--days", valid=f"1..{MOST_DAYS}")
    return now + timedelta(days=days)


def _write_pair(
    folder: Path, name: str, key: EllipticCurvePrivateKey, certificate: x509.Certificate, *, force: bool
) -> Path:
    from cryptography.hazmat.primitives import serialization as form

    pem = key.private_bytes(form.Encoding.PEM, form.PrivateFormat.PKCS8, form.NoEncryption())
    paths = folder / f"{name}.key", folder / f"{name}.crt"
    lost = ", and then all certificates made with it are worthless" if name == AUTHORITY else ""
    for path in paths:
        if path.exists() and not force:
            raise InputError(f"exists already; --force replaces it{lost}", file=str(path))
    _write(paths[0], pem, 0o600)
    _write(paths[1], certificate.public_bytes(form.Encoding.PEM), 0o644)
    return paths[1]


def _write(path: Path, data: bytes, mode: int) -> None:
    """Whole or not at all, and never readable by more than `mode` says, whatever the umask."""
    fresh = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        descriptor = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with os.fdopen(descriptor, "wb") as file:
            os.fchmod(file.fileno(), mode)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(fresh, path)
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", file=str(path)) from error
