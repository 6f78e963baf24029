"""The web process: ``python -m abbe.service.web.process CHANNEL LISTENING``, two inherited sockets. Only the core starts it."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import sys

from abbe.service.web.process import import_guard


def main() -> int:
    """Serve until the core ends the channel; return the exit code."""
    channel, listening = (socket.socket(fileno=int(text)) for text in sys.argv[1:3])
    # Ctrl-C at the terminal reaches both processes; the core decides when the web process ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    import_guard.install()
    from abbe.service.logs import configure_logs
    from abbe.service.web.process.serving import serve_pages

    configure_logs()
    with asyncio.Runner(loop_factory=asyncio.SelectorEventLoop) as runner:
        return runner.run(serve_pages(channel, listening))


if __name__ == "__main__":
    code = main()
    sys.stderr.flush()
    # Everything is closed. On a busy computer a regular interpreter shutdown takes longer than the core waits.
    os._exit(code)
