"""Include examples of tests/test_extending.py in docs/extending.md; a hook of mkdocs.

``<!-- snippet: NAME -->`` is replaced with the lines between the markers
``# --8<-- [start:NAME]`` and ``# --8<-- [end:NAME]`` of the test file.
"""

import re
import textwrap
from pathlib import Path

SOURCE = Path(__file__).parents[1] / "tests" / "test_extending.py"
_MARK = re.compile(r"<!-- snippet: (\w+) -->")
_SNIPPET = re.compile(
    r"^ *# --8<-- \[start:(\w+)\]\n(.*?)^ *# --8<-- \[end:\1\]$",
    re.MULTILINE | re.DOTALL,
)


def snippets() -> dict[str, str]:
    """Return the examples of the test file by name."""
    found = _SNIPPET.findall(SOURCE.read_text(encoding="utf-8"))
    return {name: textwrap.dedent(code).strip("\n") for name, code in found}


def on_page_markdown(markdown: str, **_) -> str:
    """Replace the markers of a page; mkdocs calls this for each page."""
    code = snippets()
    return _MARK.sub(
        lambda mark: f"```python\n{code.get(mark[1], '...')}\n```", markdown
    )
