"""``python -m sb3_combrel.zoo train|enjoy|...``; subprocesses import this module again, hence the guard."""

import sys

from sb3_combrel.zoo.commands import main

if __name__ == "__main__":
    sys.exit(main())
