"""Certificates of the ground link: modes, nothing overwritten, and checked by Python's own TLS."""

import os
import ssl
import stat
from datetime import UTC, datetime, timedelta

import pytest
import typer
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from typer.testing import CliRunner

from companion.cli import keys
from companion.cli.ground_options import ground_settings
from companion.core.errors import InputError
from companion.runtime.bus import certificates
from companion.runtime.bus.certificate_files import certificate_fingerprint, find_credentials
from companion.runtime.bus.certificates import describe_certificate, make_authority, make_certificate

NOW = datetime(2026, 6, 1, 12, tzinfo=UTC)


@pytest.fixture
def folder(tmp_path):
    make_authority(tmp_path, now=NOW)
    make_certificate(tmp_path, "drone1", hosts=["192.168.1.7", "drone1.local", "fe80::1"], now=NOW)
    make_certificate(tmp_path, "laptop", now=NOW)
    return tmp_path


def load(path):
    return x509.load_pem_x509_certificate(path.read_bytes())


def mode(path):
    return stat.S_IMODE(path.stat().st_mode)


def test_keys_are_for_their_owner_alone_whatever_the_umask(tmp_path):
    before = os.umask(0)
    try:
        make_authority(tmp_path, now=NOW)
        make_certificate(tmp_path, "a", now=NOW)
    finally:
        os.umask(before)
    assert [mode(tmp_path / name) for name in ("ca.key", "a.key", "ca.crt", "a.crt")] == [0o600, 0o600, 0o644, 0o644]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.crt", "a.key", "ca.crt", "ca.key"]  # nothing left over


def test_nothing_is_replaced_unless_forced(folder):
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    with pytest.raises(InputError, match="--force"):
        make_authority(folder, now=NOW)
    with pytest.raises(InputError, match="--force"):
        make_certificate(folder, "laptop", now=NOW)
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before
    make_certificate(folder, "laptop", now=NOW, force=True)
    changed = {name for name, data in before.items() if (folder / name).read_bytes() != data}
    assert changed == {"laptop.crt", "laptop.key"}


def test_each_certificate_is_signed_by_the_authority_for_one_purpose(folder):
    authority = load(folder / "ca.crt")
    purposes = {}
    for name in ("drone1", "laptop"):
        certificate = load(folder / f"{name}.crt")
        certificate.verify_directly_issued_by(authority)
        purposes[name] = list(certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)
        assert not certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    assert purposes == {
        "drone1": [x509.oid.ExtendedKeyUsageOID.SERVER_AUTH],
        "laptop": [x509.oid.ExtendedKeyUsageOID.CLIENT_AUTH],
    }
    limits = authority.extensions.get_extension_for_class(x509.BasicConstraints)
    assert limits.critical and limits.value.ca and limits.value.path_length == 0


def test_a_certificate_holds_as_long_as_it_says_and_never_longer_than_its_authority(tmp_path):
    make_authority(tmp_path, now=NOW, days=100)
    short, long = (make_certificate(tmp_path, f"c{days}", now=NOW, days=days) for days in (30, 365))
    assert load(short).not_valid_after_utc == NOW + timedelta(days=30)
    assert load(short).not_valid_before_utc == NOW - timedelta(hours=1)
    assert load(long).not_valid_after_utc == load(tmp_path / "ca.crt").not_valid_after_utc


def test_python_reads_the_same_fingerprint_hosts_and_key(folder):
    certificate = load(folder / "drone1.crt")
    digest = certificate.fingerprint(hashes.SHA256())
    assert certificate_fingerprint(folder / "drone1.crt") == digest.hex(":").upper()
    ssl.create_default_context(cafile=folder / "ca.crt").load_cert_chain(folder / "drone1.crt", folder / "drone1.key")
    assert describe_certificate(folder / "drone1.crt") == (
        "drone1, dialled as 192.168.1.7, drone1.local, fe80::1, until 2027-06-01"
    )
    assert describe_certificate(folder / "ca.crt") == "Understory ground link, until 2036-05-29"


@pytest.mark.parametrize("name", ["ca", "", "../x", "a/b", "-a", "a" * 64, "ä"])
def test_names_that_are_none(folder, name):
    with pytest.raises(InputError, match="NAME"):
        make_certificate(folder, name, now=NOW)


@pytest.mark.parametrize("host", ["a b", "", "-x", "*.example.org", "a..b"])
def test_hosts_that_are_none(folder, host):
    with pytest.raises(InputError, match="--host"):
        make_certificate(folder, "other", hosts=[host], now=NOW)


def test_an_authority_that_is_missing_torn_or_of_another_key_is_told(tmp_path, folder):
    with pytest.raises(InputError, match="companion keys ca"):
        make_certificate(tmp_path / "nowhere", "a", now=NOW)
    other = tmp_path / "other"
    make_authority(other, now=NOW)
    (folder / "ca.key").write_bytes((other / "ca.key").read_bytes())
    with pytest.raises(InputError, match="does not belong"):
        make_certificate(folder, "a", now=NOW)
    (folder / "ca.key").write_text("torn")
    with pytest.raises(InputError, match="cannot be read"):
        make_certificate(folder, "a", now=NOW)


def test_credentials_are_found_by_folder_by_name_and_by_preference(folder, tmp_path_factory):
    assert find_credentials(folder / "laptop").certificate == folder.resolve() / "laptop.crt"
    assert find_credentials(folder, prefer="drone1").key == folder.resolve() / "drone1.key"
    with pytest.raises(InputError, match="several"):
        find_credentials(folder)
    alone = tmp_path_factory.mktemp("alone")
    for name in ("ca.crt", "laptop.crt", "laptop.key"):
        (alone / name).write_bytes((folder / name).read_bytes())
        (alone / name).chmod(mode(folder / name))
    assert find_credentials(alone).certificate == alone.resolve() / "laptop.crt"


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda f: (f / "laptop.key").chmod(0o640), "chmod 600"),
        (lambda f: (f / "laptop.key").unlink(), "laptop.key: cannot be read"),
        (lambda f: (f / "laptop.key").write_text("x"), "no private key"),
        (lambda f: (f / "laptop.crt").write_text("x"), "no certificate"),
        (lambda f: (f / "laptop.crt").write_bytes(b"\xff"), "no certificate"),
        (lambda f: (f / "ca.crt").unlink(), "ca.crt: cannot be read"),
    ],
)
def test_credentials_that_cannot_be_used_are_told(folder, spoil, told):
    spoil(folder)
    with pytest.raises(InputError, match=told):
        find_credentials(folder / "laptop")


def test_a_folder_without_certificates_says_how_to_make_them(tmp_path):
    with pytest.raises(InputError, match="companion keys cert"):
        find_credentials(tmp_path)
    with pytest.raises(InputError, match="no folder"):
        find_credentials(tmp_path / "no" / "where")


def test_without_cryptography_the_command_that_installs_it_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(certificates, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'understory\[ground\]'"):
        make_authority(tmp_path, now=NOW)
    assert list(tmp_path.iterdir()) == []


def test_the_commands_make_and_show_but_never_print_a_key(tmp_path):
    app = typer.Typer()
    for name in ("ca", "cert", "show"):
        app.command(name)(getattr(keys, name))
    run, certs = CliRunner().invoke, str(tmp_path / "certs")
    assert run(app, ["ca", certs]).exit_code == 0
    made = run(app, ["cert", certs, "drone1", "--host", "127.0.0.1"])
    assert "dialled as 127.0.0.1" in made.output
    shown = run(app, ["show", certs]).output
    for name in ("ca", "drone1"):
        assert certificate_fingerprint(tmp_path / "certs" / f"{name}.crt") in shown
    assert "PRIVATE" not in made.output + shown
    assert isinstance(load(tmp_path / "certs" / "drone1.crt").public_key(), ec.EllipticCurvePublicKey)


def test_options_of_run_are_checked_before_anything_starts(folder):
    def settings(endpoint="tls/0.0.0.0:7448", certs=folder, rates=(), allowed=()):
        return ground_settings(endpoint, certs, rates, allowed, bus="tcp/127.0.0.1:7447", vehicle="drone1")

    assert settings("", None) is None
    good = settings(rates=["cloud=0.5", "truth=0"], allowed=["note"])
    assert (good.rates_hz, good.allowed) == ({"cloud": 0.5, "truth": 0.0}, ("note",))
    assert good.credentials.certificate.name == "drone1.crt"
    for wrong, told in [
        ({"endpoint": "tcp/0.0.0.0:7448"}, "--ground"),
        ({"certs": None}, "--ground-certs"),
        ({"endpoint": "", "rates": ["cloud=1"]}, "no --ground"),
        ({"rates": ["cloud"]}, "TOPIC=HZ"),
        ({"rates": ["cloud=nan"]}, "--ground-rate"),
        ({"rates": ["*=1"]}, "--ground-rate"),
        ({"allowed": ["mission/goal"]}, "stack's own"),
        ({"allowed": ["**"]}, "--ground-allow"),
    ]:
        with pytest.raises(InputError, match=told):
            settings(**wrong)
