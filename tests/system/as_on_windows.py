"""Takes from Python what Windows lacks, as far as Linux can play it; then runs `abbe` with the words that follow, or a file of Python."""

from __future__ import annotations

import importlib
import os
import runpy
import signal
import sys

LACKS = {
    os: ("getuid", "geteuid", "getgid", "fork", "killpg", "getpgid", "setsid", "chown", "sched_getaffinity"),
    signal: ("SIGHUP", "SIGUSR1", "SIGUSR2", "SIGKILL", "SIGQUIT", "SIGALRM", "pthread_sigmask", "setitimer"),
}
MODULES = ("fcntl", "termios", "resource", "pwd", "grp", "tty", "pty")
LOADED = ("serial", "numpy", "scipy", "multiprocessing", "subprocess", "asyncio", "shutil", "tempfile")
"""They have variants of their own for Windows, so they load before anything is taken away."""


class Missing:
    def find_spec(self, name, path=None, target=None):
        if name in MODULES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


if __name__ == "__main__":
    for name in LOADED:
        importlib.import_module(name)
    for name in MODULES:
        sys.modules.pop(name, None)
    sys.meta_path.insert(0, Missing())
    for module, names in LACKS.items():
        for name in names:
            delattr(module, name)
    words = sys.argv[1:]
    if words[0].endswith(".py"):
        runpy.run_path(words[0])
    else:
        from abbe.service.cli import run

        sys.exit(run(words))
