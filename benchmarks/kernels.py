"""Cost of a compiled program kernel by kernel: bytes, operations and microseconds.

Bytes and operations are counted in XLA's text of the program, microseconds come from a
profile. Stages are the `jax.named_scope`s of the renderer.
"""

from __future__ import annotations

import math
import re
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax

STAGES = ("order", "project", "lists", "composite")
_BYTES = {"pred": 1, "s8": 1, "u8": 1, "bf16": 2, "f16": 2, "s32": 4, "u32": 4,
          "f32": 4, "s64": 8, "u64": 8, "f64": 8}  # fmt: skip
_ARRAY = re.compile(r"\b([a-z]+[0-9]*)\[([0-9,]*)\]")
_LINE = re.compile(r"^\s*(?:ROOT )?%([\w.\-]+) = (\([^()]*\)|\S+) ([\w\-]+)\((.*)$")
_ARITHMETIC = {
    "add", "subtract", "multiply", "divide", "maximum", "minimum", "negate", "sqrt",
    "rsqrt", "exponential", "log", "log-plus-one", "logistic", "power", "tanh", "floor",
    "ceil", "round-nearest-even",
}  # fmt: skip
_PARTS = {"dynamic-slice", "slice", "gather"}


class Instruction(NamedTuple):
    """A line of a program."""

    kind: str
    arrays: str
    operands: list[str]
    rest: str

    @property
    def size(self) -> int:
        """Return the bytes of the result."""
        return sum(
            _BYTES.get(kind, 0) * _count(shape)
            for kind, shape in _ARRAY.findall(self.arrays)
        )

    @property
    def elements(self) -> int:
        """Return the number of elements of the first result."""
        found = _ARRAY.search(self.arrays)
        return _count(found[2]) if found else 0


def _count(shape: str) -> int:
    return math.prod(int(n) for n in shape.split(",") if n)


class Cost(NamedTuple):
    """Bytes read and written, operations and stage of a kernel.

    ``product`` is True for a matrix product of a library, whose kernels have no name.
    """

    bytes: int
    operations: int
    stage: str
    product: bool = False


def parse(text: str) -> dict[str, dict[str, Instruction]]:
    """Return the instructions of each computation, by name."""
    found: dict[str, dict[str, Instruction]] = {}
    lines: dict[str, Instruction] = {}
    for line in text.splitlines():
        if line.endswith("{") and not line.startswith(" "):
            name = line.removeprefix("ENTRY ").lstrip("%").split(" ")[0]
            lines = found.setdefault(name.split("(")[0], {})
        elif match := _LINE.match(line):
            name, arrays, kind, rest = match.groups()
            inside = rest.split("), ")[0]
            operands = re.findall(r"%([\w.\-]+)", inside)
            lines[name] = Instruction(kind, arrays, operands, rest)
    return found


def costs(text: str) -> dict[str, Cost]:
    """Return the cost of each instruction that is a kernel, by kernel name."""
    program = parse(text)
    made = {}
    for lines in program.values():
        for name, line in lines.items():
            if line.kind not in ("fusion", "sort", "custom-call", "copy", "reduce"):
                continue
            called = re.search(r"calls=%([\w.\-]+)", line.rest)
            inner = program.get(called[1], {}) if called else {}
            product = "__cublas" in line.rest
            moved, stage = _moved(line, lines, inner), _stage(line.rest)
            made[_kernel(name)] = Cost(moved, _worked(inner), stage, product)
    return made


def _moved(line: Instruction, lines: dict, inner: dict[str, Instruction]) -> int:
    """Count bytes: each operand once, or the part that is read; and the result."""
    users = defaultdict(list)
    for one in inner.values():
        for operand in one.operands:
            users[operand].append(one)
    parameters = {}
    for name, one in inner.items():
        if one.kind == "parameter":
            parameters[int(re.match(r"\d+", one.rest)[0])] = name  # pyright: ignore
    total = 0
    for place, operand in enumerate(line.operands):
        whole = lines[operand].size if operand in lines else 0
        using = users.get(parameters.get(place, ""), [])
        if using and all(u.kind in _PARTS for u in using):
            whole = min(whole, sum(u.size for u in using))
        elif using and all(u.kind == "dynamic-update-slice" for u in using):
            whole = 0
        total += whole
    written = line.size
    for one in inner.values():
        if one.kind == "dynamic-update-slice":
            written += inner[one.operands[1]].size - one.size
    return total + max(written, 0)


def _worked(inner: dict[str, Instruction]) -> int:
    """Count operations on floats; a multiply–add counts as two."""
    total = 0
    for one in inner.values():
        if one.kind in _ARITHMETIC and one.arrays.startswith("f"):
            total += one.elements
        elif one.kind == "reduce" and one.operands[0] in inner:
            total += inner[one.operands[0]].elements
        elif one.kind == "dot":
            left = inner[one.operands[0]]
            found = re.search(r"lhs_contracting_dims=\{(\d+)\}", one.rest)
            shape = _ARRAY.search(left.arrays)
            if found and shape:
                depth = int(shape[2].split(",")[int(found[1])])
                total += 2 * one.elements * depth
    return total


def _stage(rest: str) -> str:
    """Return the stage from the metadata, with "backward" if transposed."""
    found = re.search(r'op_name="([^"]*)"', rest)
    path = found[1] if found else ""
    parts = re.split(r"[/()]", path)
    stage = next((s for s in STAGES if s in parts), "other")
    return f"{stage}, backward" if "transpose(" in path else stage


def _kernel(name: str) -> str:
    return re.sub(r"[.\-]", "_", name)


class Kernel(NamedTuple):
    """Launches and microseconds of a kernel in one call, from a profile."""

    name: str
    operation: str
    launches: float
    us: float


def profile(function: Callable[[], Any], calls: int = 5) -> tuple[list[Kernel], float]:
    """Return the kernels of a call, and the microseconds in which any ran."""
    from jax.profiler import ProfileData

    jax.block_until_ready(function())
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            for _ in range(calls):
                jax.block_until_ready(function())
        path = max(Path(folder).rglob("*.xplane.pb"))
        data = ProfileData.from_file(str(path))
    count, took, spans = Counter(), Counter(), []
    for plane in data.planes:
        for line in plane.lines if "GPU" in plane.name else ():
            if not line.name.startswith("Stream"):
                continue
            for event in line.events:
                told = {key: str(value) for key, value in event.stats}
                key = event.name, told.get("hlo_op", "")
                count[key] += 1
                took[key] += event.duration_ns / 1e3
                spans.append((event.start_ns, event.start_ns + event.duration_ns))
    found = [Kernel(*key, count[key] / calls, took[key] / calls) for key in count]
    busy = end = 0
    for start, stop in sorted(spans):
        busy += max(0, stop - max(start, end))
        end = max(end, stop)
    return found, busy / 1e3 / calls


def by_stage(kernels: list[Kernel], known: dict[str, Cost]) -> dict[str, dict]:
    """Return microseconds, launches, bytes and operations of each stage.

    Library kernels have no name of the program: matrix products are counted for the
    stage that has most of them. "control" is the time of loops and branches.
    """
    products = Counter(cost.stage for cost in known.values() if cost.product)
    product = products.most_common(1)[0][0] if products else "other"
    rows: dict[str, Counter] = defaultdict(Counter)
    for kernel in kernels:
        cost = known.get(_kernel(kernel.operation)) or known.get(
            re.sub(r"__\d+$", "", _kernel(kernel.name))
        )
        if cost is None:
            control = re.match(r"mem|set_|cond|Memcpy|Memset", kernel.name)
            cost = Cost(0, 0, "control" if control else product)
        row = rows[cost.stage]
        row["us"] += kernel.us
        row["launches"] += kernel.launches
        row["bytes"] += cost.bytes * kernel.launches
        row["operations"] += cost.operations * kernel.launches
    return {name: dict(row) for name, row in rows.items()}
