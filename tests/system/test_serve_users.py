"""The service as a process: refused where it would be open to everybody, and behind TLS with a login by real HTTP."""

from __future__ import annotations

import ssl
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

import httpx
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import NameOID

from abbe.service.clock import SystemClock
from abbe.service.storage.store import Store
from abbe.service.users.people import UserAccounts
from tests.system.serve_bench import abbe, free_port

Refused = Callable[..., list[str]]
PHRASE = "correct horse battery staple"
MACHINE = 'name = "mill-7"\nchain = "w-X-Y-b-Z-t"\n[stroke_mm]\nX = [0, 500]\nY = [0, 400]\nZ = [-300, 0]\n[web]\n'


def add_user(folder: Path) -> None:
    with Store.open(f"sqlite:///{folder / 'abbe.sqlite3'}") as store:
        UserAccounts(store, SystemClock()).add("ana", "admin", PHRASE)


def certificate(folder: Path) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "abbe")])
    now = datetime.now(UTC)
    made = x509.CertificateBuilder(
        name, name, key.public_key(), x509.random_serial_number(), now - timedelta(days=1), now + timedelta(days=9)
    )
    here = x509.SubjectAlternativeName([x509.IPAddress(ip_address("127.0.0.1"))])
    signed = made.add_extension(here, critical=False).sign(key, hashes.SHA256())
    (folder / "abbe.crt").write_bytes(signed.public_bytes(Encoding.PEM))
    (folder / "abbe.key").write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))


def test_open_to_everybody_is_refused_in_one_line(tmp_path: Path, refused: Refused) -> None:
    file = tmp_path / "m.toml"

    def refusal(web: str) -> str:
        file.write_text(MACHINE + web)
        (line,) = refused(file)
        return line

    assert "there is no user who is admin" in refusal('host = "0.0.0.0"\n')
    assert not (tmp_path / "abbe.sqlite3").exists()  # the question has left no database behind
    add_user(tmp_path)
    assert "in clear" in refusal('host = "0.0.0.0"\n')
    assert "belong together" in refusal('certificate = "abbe.crt"\n')
    assert "error CFG-001: [web] certificate" in refusal('certificate = "abbe.crt"\nkey = "abbe.key"\n')


def test_an_audit_that_cannot_be_written_is_said_when_the_service_starts(tmp_path: Path) -> None:
    """In a process of its own: beside other tests, their traces would stand among its lines."""
    (tmp_path / "m.toml").write_text(MACHINE + "port = 0\n")
    (tmp_path / "abbe.sqlite3.audit-key").mkdir()
    with closing(abbe("serve", "-m", tmp_path / "m.toml")) as process:
        assert process.wait() == 2
    assert process.lines[-1].startswith(f"error AUD-001: the audit cannot be used: {tmp_path}/abbe.sqlite3.audit-key: ")
    assert not any("Traceback" in line for line in process.lines)


def test_a_login_over_tls(tmp_path: Path) -> None:
    add_user(tmp_path)
    certificate(tmp_path)
    port = free_port()
    (tmp_path / "m.toml").write_text(MACHINE + f'port = {port}\ncertificate = "abbe.crt"\nkey = "abbe.key"\n')
    base = f"https://127.0.0.1:{port}"
    with closing(abbe("serve", "-m", tmp_path / "m.toml")) as running:
        assert f"{base}/" in running.expect("serving")
        with httpx.Client(base_url=base, verify=ssl.create_default_context(cafile=tmp_path / "abbe.crt"), timeout=30) as client:
            assert client.get("/api/v1/status").status_code == 401
            form = {"name": "ana", "password": PHRASE}
            for origin in (base.replace("https", "http"), "https://evil.example"):
                assert client.post("/login", data=form, headers={"Origin": origin}).status_code == 403
            answer = client.post("/login", data=form, headers={"Origin": base})
            assert answer.status_code == 303
            cookie = answer.headers["set-cookie"]
            assert cookie.startswith(f"__Host-abbe-{port}=")
            for word in ("Secure", "HttpOnly", "SameSite=strict", "Path=/"):
                assert word in cookie
            assert client.get("/api/v1/status").json()["machine"] == "mill-7"
            token = client.get("/api/v1/session").json()["csrf_token"]
            assert client.post("/logout", headers={"Origin": base}).status_code == 403
            assert client.post("/logout", headers={"Origin": base, "X-CSRF-Token": token}).status_code == 303
            assert client.get("/api/v1/status").status_code == 401
        assert running.terminate()[0] == 0
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        told = [(r.action, r.outcome) for r in store.audit.events()]
    assert told[0] == ("abbe serve", "begun")
    assert [outcome for action, outcome in told if action == "POST /login"] == ["refused 403", "refused 403", "done 303"]
    assert [outcome for action, outcome in told if action == "POST /logout"] == ["refused 403", "done 303"]
