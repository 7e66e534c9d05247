"""Set up JAX as the command line does, on import.

Memory in large pages, one device per core, and results that are waited for. With
``--queued``, calls may queue, as is the default of the library.
"""

import sys

import gsjax
from gsjax.runtime.setup import restart_with_large_pages

QUEUED = "--queued" in sys.argv
restart_with_large_pages()
gsjax.use_all_cores(queued=QUEUED)
