"""Generate the option tables of docs/reference/cli.md; a hook of mkdocs.

The tables are read from the source of gsjax/cli, where an option is a field followed by
its help text, so that building the pages imports neither gsjax nor JAX.
"""

import ast
import re
from itertools import pairwise
from pathlib import Path

SOURCE = Path(__file__).parents[1] / "gsjax" / "cli"
_MARK = re.compile(r"<!-- options: (\w+) -->")
_METAVARS = {"int": "N", "float": "X", "str": "TEXT", "Path": "PATH", "bool": ""}
# Types of gsjax.cli.options.
_METAVARS |= {"Size": "WxH", "OptionalSize": "WxH", "Kinds": "KINDS"}
_METAVARS |= {"Color": "R,G,B", "Budget": "ERROR", "Times": "T|T0:T1"}


def _sources() -> list[str]:
    return [path.read_text(encoding="utf-8") for path in sorted(SOURCE.glob("*.py"))]


def command_classes() -> dict[str, str]:
    """Return the class of each command by its name."""
    pattern = re.compile(r'^ +"(\w+)": \("\w+", "(\w+Command)"\),$', re.MULTILINE)
    return dict(pair for text in _sources() for pair in pattern.findall(text))


def fields(command: str) -> list[tuple[ast.AnnAssign, str]]:
    """Return the fields of a command with their help, inherited ones last.

    Options that all commands share are left out.
    """
    classes = {
        node.name: node
        for text in _sources()
        for node in ast.parse(text).body
        if isinstance(node, ast.ClassDef)
    }
    found, names = [], [command_classes()[command]]
    while names:
        node = classes[names.pop(0)]
        found += _documented_fields(node.body)
        bases = {ast.unparse(base) for base in node.bases}
        names += sorted(bases & set(classes) - {"Command"})
    return found


def _documented_fields(body: list[ast.stmt]):
    for field, text in pairwise(body):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
            yield field, " ".join(ast.literal_eval(text.value).split())


def row(field: ast.AnnAssign, help_text: str) -> str:
    """Return a table row: the option, its default, its help."""
    kind, name = ast.unparse(field.annotation), ast.unparse(field.target)
    choices = re.search(r"Literal\[(.*?)\]", kind)
    metavar = re.search(r"metavar='(.*?)'", kind)
    plain = re.search(rf"\b({'|'.join(_METAVARS)})\b", kind)
    if metavar:
        value = metavar[1]
    elif choices:
        value = ", ".join(str(v) for v in ast.literal_eval(f"[{choices[1]}]"))
    else:
        value = _METAVARS[plain[1]] if plain else ""
    if kind.startswith("tuple"):
        value += " …"
    value = f"*{value}*" if value else ""
    option = f"`--{name.replace('_', '-')}`"
    if "'-o'" in kind:
        option = f"`-o`, {option}"
    written = value if "Positional" in kind else f"{option} {value}".strip()
    default = "" if field.value is None else _literal(field.value)
    cells = (written, f"`{default}`" if default else "", help_text)
    return "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"


def _literal(value: ast.expr) -> str:
    """Return a default as it is typed; "" for one that is off or None."""
    if isinstance(value, ast.Call):  # Path("…")
        value = value.args[0]
    plain = ast.literal_eval(value)
    if isinstance(plain, tuple):
        plain = ("x" if plain and type(plain[0]) is int else ",").join(map(str, plain))
    return "" if plain is None or plain is False else str(plain)


def table(command: str) -> str:
    """Return the options of a command as a Markdown table."""
    rows = [row(*field) for field in fields(command)]
    if not rows:
        return "No options."
    return "\n".join(["| option | default | what it does |", "|---|---|---|", *rows])


def on_page_markdown(markdown: str, **_) -> str:
    """Replace the markers of a page; mkdocs calls this for each page."""
    return _MARK.sub(lambda mark: table(mark[1]), markdown)
