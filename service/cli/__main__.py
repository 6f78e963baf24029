"""``abbe`` as a module, for child processes."""

from abbe.service.cli import main

if __name__ == "__main__":
    main()
