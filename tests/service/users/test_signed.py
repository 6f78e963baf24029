"""Signed compensation files: whole, trusted, for this machine, base, limits and day - or refused. Unsigned ones are candidates."""

from __future__ import annotations

import json
import random
import stat
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

from abbe.service.cli import run
from abbe.service.errors import KeyRefused, SignatureRefused
from abbe.service.signed.container import ExpectedContent, check, claims_of, sign
from abbe.service.signed.keys import new_key, public_of, read_key
from abbe.service.storage.store import Store
from tests.service.formats.test_choice import _document, _known

NOW = datetime(2026, 11, 22, 9, tzinfo=UTC)
FLIPS = 1000
FILES = {"a.ini": b"$AA_ENC_COMP[0,0]=0.001\nM17\n", "b.ini": bytes(range(256))}
MACHINE = 'name = "{name}"\nchain = "w-X-Y-b-Z-t"\n[stroke_mm]\nX = [0, 500]\nY = [0, 400]\nZ = [-300, 0]\n{more}'


@pytest.fixture
def key() -> Ed25519PrivateKey:
    return Ed25519PrivateKey.from_private_bytes(bytes(range(32)))


def sealed(key: Ed25519PrivateKey, days: float = 30.0) -> bytes:
    return sign(claims_of("mill-7", "siemens-cec", FILES, "none", "5" * 64, (NOW, NOW + timedelta(days=days))), key)


def expected(key: Ed25519PrivateKey, **other: str) -> ExpectedContent:
    here = {"machine": "mill-7", "limits": "5" * 64, "form": "siemens-cec", "base": "none"} | other
    return ExpectedContent(**here, trusted=[public_of(key)])  # type: ignore[arg-type]


def test_what_was_signed_is_taken_in(key: Ed25519PrivateKey) -> None:
    found = check(sealed(key), FILES, expected(key), NOW + timedelta(days=29))
    assert (found.machine, found.base, sorted(found.files)) == ("mill-7", "none", ["a.ini", "b.ini"])
    assert sealed(key) == sealed(key)


def test_every_flipped_bit_is_refused(key: Ed25519PrivateKey) -> None:
    """In the signature file and in the files: each bit anywhere, a thousand of them."""
    rng, seal = random.Random(20261122), sealed(key)
    parts = {"": seal, **FILES}
    places = [(name, k) for name, content in parts.items() for k in range(8 * len(content))]
    refused = 0
    for name, k in rng.sample(places, FLIPS):
        flipped = bytearray(parts[name])
        flipped[k // 8] ^= 1 << (k % 8)
        now = {**parts, name: bytes(flipped)}
        with pytest.raises(SignatureRefused):
            check(now.pop(""), now, expected(key), NOW)
        refused += 1
    assert refused == FLIPS


def test_another_machine_base_limit_format_day_or_signer_is_refused(key: Ed25519PrivateKey) -> None:
    seal = sealed(key)
    for other in ({"machine": "mill-8"}, {"base": "ab"}, {"limits": "6" * 64}, {"form": "fanuc"}):
        with pytest.raises(SignatureRefused, match=f"signed for {'format' if 'form' in other else next(iter(other))}"):
            check(seal, FILES, expected(key, **other), NOW)
    for moment in (NOW + timedelta(days=30), NOW - timedelta(seconds=1), NOW + timedelta(days=9999)):
        with pytest.raises(SignatureRefused, match="holds until 2026-12-22T09:00"):
            check(seal, FILES, expected(key), moment)
    with pytest.raises(SignatureRefused, match="not trusted here"):
        check(seal, FILES, expected(Ed25519PrivateKey.generate()), NOW)
    stranger = json.loads(sealed(Ed25519PrivateKey.generate()))
    forged = json.dumps({**stranger, "key": public_of(key)}, sort_keys=True, separators=(",", ":")).encode() + b"\n"
    with pytest.raises(SignatureRefused, match="does not match the claims"):  # a trusted name over a stranger's signature
        check(forged, FILES, expected(key), NOW)
    for files in ({"a.ini": FILES["a.ini"]}, {**FILES, "c.ini": b""}, {"b.ini": FILES["a.ini"], "a.ini": FILES["b.ini"]}):
        with pytest.raises(SignatureRefused, match="differs from what was signed"):
            check(seal, files, expected(key), NOW)


def test_a_day_before_the_first_or_after_the_last_is_refused_in_one_line(key: Ed25519PrivateKey) -> None:
    """Written with a zone so that in UTC there is no such day; signed by somebody whose key is trusted."""
    good = claims_of("mill-7", "siemens-cec", FILES, "none", "5" * 64, (NOW, NOW + timedelta(days=30)))
    for days in ({"signed_utc": "0001-01-01T00:00:00+23:59"}, {"expiry_utc": "9999-12-31T23:59:59-23:59"}, {"expiry_utc": "99999-01-01"}):
        with pytest.raises(SignatureRefused, match="is not of the form"):
            check(sign(replace(good, **days), key), FILES, expected(key), NOW)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{}",
        "[]",
        "null",
        "[" * 5000,
        "\xff",
        '{"format":"abbe-signed/1"}',
        '{"claims":{},"format":"abbe-signed/1","key":1,"signature":"x"}',
    ],
)
def test_what_is_no_signature_is_refused_in_one_line(key: Ed25519PrivateKey, text: str) -> None:
    with pytest.raises(SignatureRefused, match="is not of the form"):
        check(text.encode("latin-1") + b"\n", FILES, expected(key), NOW)


def test_keys(tmp_path: Path) -> None:
    path = tmp_path / "key.pem"
    public = new_key(path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert public_of(read_key(path)) == public
    with pytest.raises(KeyRefused, match="never overwritten"):
        new_key(path)
    path.chmod(0o644)
    with pytest.raises(KeyRefused, match="others may read"):
        read_key(path)
    other = tmp_path / "other.pem"
    for content in (
        b"",
        b"nonsense",
        rsa.generate_private_key(65537, 2048).private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()),
    ):
        other.write_bytes(content)
        other.chmod(0o600)
        with pytest.raises(KeyRefused):
            read_key(other)
    with pytest.raises(KeyRefused, match="cannot be read"):
        read_key(tmp_path / "none.pem")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Path:
    """A solution of a machine with its machine file, that of another, a key; the database is there."""
    monkeypatch.chdir(tmp_path)
    solution = _document(_known())
    solution["machine"]["name"] = "mill-7"
    (tmp_path / "solution.json").write_text(json.dumps(solution))
    assert run(["key", "new", "key.pem"]) == 0
    public = capsys.readouterr().out.strip()
    (tmp_path / "m.toml").write_text(MACHINE.format(name="mill-7", more=f'[signatures]\ntrusted = ["{public}"]\n'))
    (tmp_path / "other.toml").write_text(MACHINE.format(name="mill-8", more=f'[signatures]\ntrusted = ["{public}"]\n'))
    (tmp_path / "stranger.toml").write_text(MACHINE.format(name="mill-7", more=""))
    Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}").close()
    return tmp_path


def test_export_signs_and_import_checks(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    export = ["comp", "export", "solution.json", "--format", "mach4", "--out", "out"]
    bring = ["comp", "import", "out", "--format", "mach4", "--json", "--machine"]

    def status(machine: str, *more: str) -> str:
        code = run([*bring, machine, *more])
        out, err = capsys.readouterr()
        return json.loads(out)["status"] if code == 0 else err.split(":")[0]

    assert run(export) == 0
    capsys.readouterr()
    assert status("m.toml") == "candidate"  # unsigned: never more than that
    for file in (folder / "out").iterdir():
        file.unlink()
    (folder / "out").rmdir()
    assert run([*export, "--sign", "key.pem"]) == 2  # for which machine?
    assert run([*export, "--sign", "key.pem", "--machine", "other.toml"]) == 2  # not the solution's
    assert not (folder / "out").exists()
    assert run([*export, "--sign", "key.pem", "--machine", "m.toml", "--days", "10"]) == 0
    capsys.readouterr()
    assert (folder / "out.sig").exists()
    assert status("m.toml") == "signed"
    assert status("other.toml") == status("stranger.toml") == "error SIG-001"
    assert status("stranger.toml", "--trust", public_of(read_key(folder / "key.pem"))) == "signed"
    assert status("m.toml", "--base", "ab" * 32) == "error SIG-001"
    table = next((folder / "out").iterdir())
    table.write_text(table.read_text() + "\n")
    assert status("m.toml") == "error SIG-001"
    with Store.open(f"sqlite:///{folder / 'abbe.sqlite3'}") as store:
        told = [(r.action, r.outcome) for r in store.audit.events()]
    signed = [outcome for action, outcome in told if action == "abbe comp export"]
    assert signed == ["SIG-001", "SIG-001", "done"]  # without a machine file it is the default database, which is the same here
    assert [outcome for action, outcome in told if action == "abbe comp import"].count("SIG-001") == 4
