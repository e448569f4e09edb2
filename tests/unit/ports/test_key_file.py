"""Key files: written for one reader, never overwritten by accident, never shown."""

from __future__ import annotations

import os
import stat

import pytest
import typer
from typer.testing import CliRunner

from companion.cli import keys
from companion.core.errors import InputError
from companion.runtime.ports.key_file import fingerprint, load_key, new_key


@pytest.fixture
def file(tmp_path):
    return tmp_path / "drone.key"


def test_a_new_key_is_random_private_and_reads_back(file, tmp_path):
    before = os.umask(0)
    try:
        key = new_key(file)
    finally:
        os.umask(before)
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert file.read_text() == key.hex() + "\n"
    assert load_key(file) == key and len(key) == 32
    assert new_key(tmp_path / "other.key") != key


def test_an_old_key_is_replaced_by_force_only(file):
    old = new_key(file)
    with pytest.raises(InputError, match="exists already; --force"):
        new_key(file)
    assert load_key(file) == old
    file.chmod(0o644)
    new = new_key(file, force=True)
    assert load_key(file) == new != old and list(file.parent.iterdir()) == [file]


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o666, 0o601])
def test_a_key_that_others_can_use_is_refused(file, mode):
    new_key(file)
    file.chmod(mode)
    with pytest.raises(InputError, match=f"can be used by others .mode {mode:04o}.; run: chmod 600 {file}"):
        load_key(file)


@pytest.mark.parametrize(
    "text", ["", "zz" * 32, "ab" * 31, "ab" * 33, "\x00\xff" * 40], ids=["empty", "no hex", "short", "long", "binary"]
)
def test_what_is_no_key_is_refused(file, text):
    new_key(file)
    file.write_text(text)
    with pytest.raises(InputError, match=r"holds no signing key .valid: 64 hex digits"):
        load_key(file)


def test_missing_files_and_folders_are_named(tmp_path):
    with pytest.raises(InputError, match="cannot be read: No such file"):
        load_key(tmp_path / "none")
    with pytest.raises(InputError, match=r"is no file|Is a directory"):
        load_key(tmp_path)
    with pytest.raises(InputError, match="cannot be written: No such file"):
        new_key(tmp_path / "none" / "a.key")


def test_the_command_shows_the_fingerprint_and_never_the_key(file):
    app = typer.Typer()
    app.command("new")(keys.new)
    app.command("show")(keys.show)
    made = CliRunner().invoke(app, ["new", str(file)])
    shown = CliRunner().invoke(app, ["show", str(file)])
    key = load_key(file)
    assert made.exit_code == shown.exit_code == 0
    assert fingerprint(key) in made.stdout and fingerprint(key) in shown.stdout
    assert key.hex()[:8] not in made.stdout + shown.stdout
    again = CliRunner().invoke(app, ["new", str(file)])
    assert isinstance(again.exception, InputError) and again.exception.exit_code == 2
