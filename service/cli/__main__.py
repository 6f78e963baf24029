"""``abbe`` as a module, for children of ours."""

from abbe.service.cli import main

if __name__ == "__main__":
    main()
