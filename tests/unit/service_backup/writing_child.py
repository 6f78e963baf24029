"""``python writing_child.py URL MACHINE_ID``: writes one check after the other and says the number of each that is on disk."""

from __future__ import annotations

import sys

from service.storage.store import Store


def main() -> None:
    with Store.open(sys.argv[1]) as store:
        while True:
            number = store.add_verification(int(sys.argv[2]), None, "pass", {"text": "x" * 2000})
            sys.stdout.write(f"{number}\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
