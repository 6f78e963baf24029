"""What the machine file says of broker and OPC UA: relative files, and one clear line for what cannot work."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

import pytest

from abbe.service.cli.administration.serve import setup_of
from abbe.service.config import load_machine
from abbe.service.errors import ConfigError
from tests.certificates import authority, issued

HEAD = """name = "mill-7"
chain = "w-X-Y-b-Z-t"
[stroke_mm]
X = [0.0, 600.0]
Y = [0.0, 500.0]
Z = [0.0, 450.0]
"""


def test_the_extra_is_there_where_it_is_demanded(require: Callable[[str, bool, str], None]) -> None:
    """The tests of the server skip themselves without it, before they could ask."""
    require("asyncua", importlib.util.find_spec("asyncua") is not None, "asyncua is not installed")


def setup(folder: Path, text: str) -> object:
    (folder / "machine.toml").write_text(HEAD + text)
    return setup_of(load_machine(folder / "machine.toml"))


def test_nothing_is_served_or_published_unless_asked_for(tmp_path: Path) -> None:
    made = setup(tmp_path, "")
    assert made.opcua is None
    assert made.broker is None


def test_files_lie_beside_the_machine_file(tmp_path: Path) -> None:
    ca = authority(tmp_path, "plant-ca")
    own = issued(tmp_path, "abbe", ca, addresses=("127.0.0.1",))
    made = setup(
        tmp_path,
        f"""[mqtt]
url = "mqtts://broker.test"
ca = "{ca.pem.name}"
[opcua]
enabled = true
host = "0.0.0.0"
port = 4841
certificate = "{own.pem.name}"
key = "{own.key_pem.name}"
clients = ["{own.pem.name}"]
""",
    )
    assert (made.broker.port, made.broker.files.ca) == (8883, str(ca.pem))
    assert made.opcua.clients == (str(own.pem),)
    assert (made.opcua.exposed, made.opcua.port, made.opcua.key) == (True, 4841, str(own.key_pem))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[mqtt]\nurl = "mqtt://broker.test"\nca = "ca.pem"', "expected url = mqtts://host:8883"),
        ('[mqtt]\nurl = "mqtts://broker.test"\nkey = "k.pem"', "certificate and key belong together"),
        ('[mqtt]\nurl = "mqtts://broker.test"\nca = "gone.pem"', "gone.pem.*No such file"),
        ('[mqtt]\nurl = "mqtts://broker.test"\nca = "machine.toml"', r"machine.toml\): \["),
        ('[opcua]\nenabled = true\nkey = "k.pem"', "certificate and key belong together"),
        ('[opcua]\nenabled = true\nhost = "0.0.0.0"', "needs certificate, key and clients"),
        ("[opcua]\nenabled = true\nwritable = true", "writable"),
    ],
)
def test_what_cannot_work_is_said_at_the_start(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        setup(tmp_path, text)
