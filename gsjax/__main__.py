"""`python -m gsjax`: the command line."""

import sys

from gsjax.cli import program

sys.exit(program())
