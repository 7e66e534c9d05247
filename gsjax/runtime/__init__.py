"""The process: devices, memory, compiled programs, files and the console.

`setup` prepares the process when gsjax is imported, and does not import JAX; `devices`
is the one module that asks for JAX's backend. `machine` and `memory` read limits of the
system, `compilation_cache` keeps JAX's cache tidy. `loops` and `custom_transpose` are
JAX building blocks. `files` reads and writes safely, `settings` checks numbers,
`console` prints, `timing` measures.
"""
