"""Tables of the command line's options, for cli.md: a hook of mkdocs.

Read from the source of gsjax/commands, where an option is a field with its help below,
so that building the pages imports neither gsjax nor JAX.
"""

import ast
import re
from itertools import pairwise
from pathlib import Path

SOURCE = Path(__file__).parents[1] / "gsjax"
_MARK = re.compile(r"<!-- options: (\w+) -->")
_WORDS = {"int": "N", "float": "X", "str": "TEXT", "Path": "PATH", "bool": ""}


def command_classes() -> dict[str, str]:
    """Names of the commands, and of the classes that they are."""
    text = (SOURCE / "cli.py").read_text(encoding="utf-8")
    return dict(re.findall(r'^        "(\w+)": (\w+Command),$', text, re.M))


def fields(command: str) -> list[tuple[ast.AnnAssign, str]]:
    """The fields of a command, each with its help; those that it inherits last, but
    for those that all have."""
    classes = {
        node.name: node
        for path in sorted((SOURCE / "commands").glob("*.py"))
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef)
    }
    found, names = [], [command_classes()[command]]
    while names:
        node = classes[names.pop(0)]
        found += _told(node.body)
        bases = {ast.unparse(base) for base in node.bases}
        names += sorted(bases - {"Command"})
    return found


def _told(body: list[ast.stmt]):
    for field, text in pairwise(body):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
            yield field, " ".join(ast.literal_eval(text.value).split())


def row(field: ast.AnnAssign, told: str) -> str:
    """A row of the table: what to write, its default, what it does."""
    kind, name = ast.unparse(field.annotation), ast.unparse(field.target)
    choices = re.search(r"Literal\[(.*?)\]", kind)
    metavar = re.search(r"metavar='(.*?)'", kind)
    plain = re.search(r"\b(int|float|str|Path|bool)\b", kind)
    if metavar:
        value = metavar[1]
    elif choices:
        value = ", ".join(str(v) for v in ast.literal_eval(f"[{choices[1]}]"))
    else:
        value = _WORDS[plain[1]] if plain else ""
    if kind.startswith("tuple"):
        value += " …"
    value = f"*{value}*" if value else ""
    option = f"`--{name.replace('_', '-')}`"
    if "'-o'" in kind:
        option = f"`-o`, {option}"
    written = value if "Positional" in kind else f"{option} {value}".strip()
    default = "" if field.value is None else _literal(field.value)
    cells = (written, f"`{default}`" if default else "", told)
    return "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"


def _literal(value: ast.expr) -> str:
    """A default as it would be typed; nothing for what is off or left open."""
    if isinstance(value, ast.Call):  # Path("…")
        value = value.args[0]
    plain = ast.literal_eval(value)
    return "" if plain is None or plain is False or plain in ((), "") else str(plain)


def table(command: str) -> str:
    """The options of a command as a Markdown table, or that there is none."""
    rows = [row(*field) for field in fields(command)]
    if not rows:
        return "No options."
    return "\n".join(["| option | default | what it does |", "|---|---|---|", *rows])


def on_page_markdown(markdown: str, **_) -> str:
    """Called by mkdocs for each page."""
    return _MARK.sub(lambda mark: table(mark[1]), markdown)
