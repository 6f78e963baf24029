"""One of two services that want the same slots: ``python racing_child.py URL COUNT``. Starts on a line from stdin, prints what it won."""

from __future__ import annotations

import json
import sys
from datetime import UTC, datetime, timedelta

from abbe.service.storage.store import Store

FIRST = datetime(2026, 6, 1, tzinfo=UTC)


def main() -> None:
    with Store.open(sys.argv[1]) as store:
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        sys.stdin.readline()
        won = [n for n in range(int(sys.argv[2])) if store.slots.claim("mill-7/weekly", FIRST + timedelta(minutes=n))]
        sys.stdout.write(json.dumps(won) + "\n")
        sys.stdout.flush()
        sys.stdin.readline()  # the parent looks at the open slots while this process lives, and once it is gone
    sys.stdout.write("bye\n")


if __name__ == "__main__":
    main()
