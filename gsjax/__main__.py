"""`python -m gsjax`: the command line."""

import sys

from gsjax.cli import main

sys.exit(main())
