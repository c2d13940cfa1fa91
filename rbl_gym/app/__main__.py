"""``python -m rbl_gym.app`` runs ``rbl-gym``."""

import sys

from rbl_gym.app.cli import main

if __name__ == "__main__":
    sys.exit(main())
