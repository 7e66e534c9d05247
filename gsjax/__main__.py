"""`python -m gsjax` runs the command line."""

import sys

from gsjax.cli.main import program

sys.exit(program())
