"""Run the command ``abbe`` as ``python -m abbe.service.cli``, as child processes do."""

from abbe.service.cli import main

if __name__ == "__main__":
    main()
