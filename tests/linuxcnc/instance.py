"""One LinuxCNC with the bridge in front of it, in namespaces of its own."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import socket
import subprocess
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from tests.patience import within

Point = tuple[float, float, float]
ROOT = Path(__file__).resolve().parents[2]
DEPLOY = ROOT / "deploy" / "linuxcnc"
DRIVES = Path(__file__).with_name("drives.py")
PATIENCE_S = 60.0
SAMPLER = """
loadrt sampler depth=32768 cfg=ffffff
net abbe-cmd-x => sampler.0.pin.0
net abbe-cmd-y => sampler.0.pin.1
net abbe-cmd-z => sampler.0.pin.2
net drive-x => sampler.0.pin.3
net drive-y => sampler.0.pin.4
net drive-z => sampler.0.pin.5
net abbe-path-running => sampler.0.enable
addf sampler.0 servo-thread
"""
"""Commands and drive commands of one instant, in every servo period of a path. A program that looks now and then sees few of them, and on
a busy computer fewer."""


def missing() -> str:
    """Why LinuxCNC cannot be started here; empty when it can."""
    for program in ("linuxcnc", "halcmd", "unshare", "nsenter", "setpriv"):
        if shutil.which(program) is None:
            return f"{program} is not installed"
    if subprocess.run(["unshare", "-n", "-i", "-p", "-f", "-m", "--mount-proc", "true"], capture_output=True).returncode:
        return "no right to make namespaces (root or CAP_SYS_ADMIN)"
    return ""


class Instance:
    """Start with ``start``; the port stays the same over restarts. ``seconds`` is how long the last start took."""

    def __init__(self) -> None:
        self.run = Path(tempfile.mkdtemp(prefix="lcnc"))
        self.run.chmod(0o755)  # the control's real-time process is nobody
        self.listening = socket.create_server(("127.0.0.1", 0))
        self.port = self.listening.getsockname()[1]
        self.seconds = 0.0
        self._process: asyncio.subprocess.Process | None = None
        self._drives: asyncio.subprocess.Process | None = None

    async def start(self) -> None:
        begin = time.monotonic()
        (self.run / "ready").unlink(missing_ok=True)
        (self.run / "bridge.log").write_text("")
        drives = self.run / "drives.hal"  # a test's own, or the simulated ones
        text = (drives if drives.exists() else DEPLOY / "drives.hal").read_text()
        drives.write_text(text.removesuffix(SAMPLER) + SAMPLER)
        fd = self.listening.fileno()
        self._process = await asyncio.create_subprocess_exec(
            # whatever becomes of us, it does not outlive us
            *("setpriv", "--pdeathsig", "KILL", str(DEPLOY / "isolated.sh"), str(self.run)),
            pass_fds=(fd,),
            env=os.environ | {"ABBE_LISTEN_FD": str(fd)},
        )
        async with asyncio.timeout(PATIENCE_S):
            while not ((self.run / "ready").exists() and "ready on" in self.bridge_log()):
                assert self._process.returncode is None, self.logs()
                await asyncio.sleep(0.05)
        self.seconds = time.monotonic() - begin
        self._drives = await asyncio.create_subprocess_exec(
            *self.inside("/usr/bin/python3", "-c", DRIVES.read_text()), stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )

    def bridge_log(self) -> str:
        return (self.run / "bridge.log").read_text()

    def logs(self) -> str:
        texts = [
            f"--- {name}\n{(self.run / name).read_text()[-2000:]}"
            for name in ("linuxcnc.log", "linuxcnc_debug.txt", "bridge.log")
            if (self.run / name).exists()
        ]
        return "\n".join(texts)

    async def hal(self, *names: str) -> list[float]:
        """Values of HAL items."""
        return (await self._ask("get " + " ".join(names), 1))[0]

    async def drives(self) -> Point:
        """Where the drives are told to stand, mm."""
        x, y, z = await self.hal("drive-x", "drive-y", "drive-z")
        return x, y, z

    async def path_rows(self) -> list[list[float]]:
        """Commands and drive commands on all paths since the last call. The bridge ends a path some looks after the axes stand."""
        return await self._ask("rows", 0)

    async def _ask(self, line: str, n_lines: int) -> list[list[float]]:
        assert self._drives is not None
        assert self._drives.stdin is not None
        assert self._drives.stdout is not None
        self._drives.stdin.write(line.encode() + b"\n")
        async with asyncio.timeout(PATIENCE_S):
            count = n_lines or int(await self._drives.stdout.readline())
            return [[float(word) for word in (await self._drives.stdout.readline()).split()] for _ in range(count)]

    def halcmd(self, *words: str, text: str | None = None) -> None:
        """What somebody at the machine's switches would do; ``-f`` with ``text``: many commands at once."""
        subprocess.run(self.inside("halcmd", "-s", *words), input=text, text=True, check=True, timeout=PATIENCE_S)

    def faster(self, velocity_mm_s: int, acceleration_mm_s2: int) -> None:
        """Let the next start have quicker axes than the configuration's."""
        text = (DEPLOY / "abbe.ini").read_text()
        text = re.sub(r"(VELOCITY = )500", rf"\g<1>{velocity_mm_s}", text)
        (self.run / "abbe.ini").write_text(re.sub(r"(ACCELERATION = )4000", rf"\g<1>{acceleration_mm_s2}", text))

    async def stop(self) -> None:
        """End the control as its operator does: by leaving the display."""
        if self._drives is not None:
            await self._drives.communicate(b"")  # its input ends
            self._drives = None
        if self._process is not None and self._process.returncode is None:
            await (await asyncio.create_subprocess_exec(*self.inside("pkill", "-TERM", "-f", "display.py"))).wait()
            with suppress(TimeoutError):
                async with asyncio.timeout(within(20)):
                    await self._process.wait()
        await self.kill()

    async def kill(self) -> None:
        """End everything at once: the first process of the namespace takes all others with it."""
        if self._process is not None and self._process.returncode is None:
            self._process.kill()
            await self._process.wait()
        if self._drives is not None:
            await self._drives.communicate()
        self._process = self._drives = None

    async def close(self) -> None:
        self.listening.close()
        try:
            await self.kill()
        finally:
            shutil.rmtree(self.run, ignore_errors=True)

    def inside(self, *command: str) -> list[str]:
        assert self._process is not None
        first = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text().split()[0]
        return ["nsenter", "-t", first, "-i", "-n", "-p", "-m", "env", f"HOME={self.run}", *command]
