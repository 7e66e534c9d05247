"""The command line: argument parsing with tyro, and one module per command.

`main` runs a command and turns errors into exit codes; `parsing` reads the arguments;
`options` holds the types of options. A command is a dataclass whose docstrings are its
help texts. Names of strategies, presets and paths become objects in its `run`.
"""
