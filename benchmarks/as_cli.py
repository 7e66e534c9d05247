"""To import this sets a benchmark up as the command line is: memory in large pages, a
device for each core, and calls that are waited for; with ``--queued``, where a program
takes it, calls that may pile up, as is the library's default.
"""

import sys

import gsjax
from gsjax.runtime.setup import restart_with_large_pages

QUEUED = "--queued" in sys.argv
restart_with_large_pages()
gsjax.use_all_cores(queued=QUEUED)
