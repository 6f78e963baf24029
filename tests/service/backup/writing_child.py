"""``python writing_child.py URL MACHINE_ID``: writes one check after the other and says the number of each that is on disk."""

from __future__ import annotations

import sys
import threading
import time

from abbe.service.storage.store import Store


def main() -> None:
    with Store.open(sys.argv[1]) as store:
        while True:
            begun_s = time.monotonic()
            number = store.verifications.add(int(sys.argv[2]), None, "pass", {"text": "x" * 2000})
            sys.stdout.write(f"{number}\n")
            sys.stdout.flush()
            # As long again nobody has the database: SQLite is not fair, and on a slow disk whoever waits would never get it.
            threading.Event().wait(time.monotonic() - begun_s)


if __name__ == "__main__":
    main()
