"""Generate the benchmark tables of README.md and docs/benchmarks/index.md.

``python docs/numbers.py`` rewrites every block between ``<!-- benchmarks: NAME -->``
and ``<!-- /benchmarks: NAME -->`` from the JSON files in benchmarks/results. With
``--check`` it changes nothing and exits with status 1 if a block is out of date.
"""

import json
import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PAGES = (ROOT / "README.md", ROOT / "docs" / "benchmarks" / "index.md")
_BLOCK = re.compile(
    r"(<!-- benchmarks: (\w+) -->\n).*?(<!-- /benchmarks: \2 -->)", re.DOTALL
)
Row = tuple[str, ...]


def result(name: str) -> dict[str, Any]:
    """Return the contents of a result file."""
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def row_of(data: dict[str, Any], **entries: Any) -> dict[str, Any]:
    """Return the first row of a result whose entries equal ``entries``."""
    return next(
        row
        for row in data["rows"]
        if all(row.get(key) == value for key, value in entries.items())
    )


def machine(data: dict[str, Any]) -> str:
    """Return the machine and date of a result, in one short phrase."""
    where = data["machine"]
    devices = where["devices"]
    gpu = devices.split(" × ")[-1]
    name = where["cpu"].replace("(R)", "").replace(" Processor", "")
    return f"{name if gpu == 'cpu' else gpu}, {where['date']}"


def seconds(value: float) -> str:
    """Format seconds with about three significant digits."""
    return f"{1e3 * value:.3g} ms" if value < 1 else f"{value:.3g} s"


def link(page: Path, program: str) -> str:
    """Return the program of a benchmark as a link, or as a path outside README.md."""
    file = f"benchmarks/{program}.py"
    return f"[{program}]({file})" if page.name == "README.md" else f"`{file}`"


def headline(page: Path) -> list[Row]:
    """Return the rows of the README."""
    demo, gpu = result("demo"), result("accelerator_gpu")
    compositor, kills = result("compositor"), result("kills")
    one = demo["rows"][0]
    guitar = row_of(compositor, scene="guitar")
    on_gpu = [
        row_of(gpu, scene="guitar", program=program, stage="all")["us"] / 1e6
        for program in ("forward", "value and gradient")
    ]
    same = sum(row["same bits"] for row in kills["rows"])
    return [
        (
            "`gsjax demo` from a cold start",
            f"{one['psnr']:.1f} dB after {seconds(one['seconds'])}",
            machine(demo),
            link(page, "demo"),
        ),
        (
            "guitar: image; value and gradient",
            f"{seconds(guitar['render ms'] / 1e3)};"
            f" {seconds(guitar['render v+g ms'] / 1e3)}",
            machine(compositor),
            link(page, "compositor"),
        ),
        (
            "guitar on a GPU: image; value and gradient",
            f"{seconds(on_gpu[0])}; {seconds(on_gpu[1])}",
            machine(gpu),
            link(page, "accelerator"),
        ),
        (
            "compositing time relative to two-thread C++: image; value and gradient",
            f"{guitar['forward / C++']:.2f} ×;"
            f" {guitar['composite v+g ms'] / guitar['C++ v+g plain ms']:.2f} ×",
            machine(compositor),
            link(page, "compositor"),
        ),
        (
            "training runs killed at a random moment that resumed to the same bits",
            f"{same} of {len(kills['rows'])}",
            machine(kills),
            link(page, "kills"),
        ),
    ]


def rendering(page: Path) -> list[Row]:
    """Return what a render costs, by scene."""
    compositor, scaling, gpu = map(result, ("compositor", "scaling", "scaling_gpu"))
    rows = [
        (
            f"{row['scene'].removesuffix('_run')}",
            seconds(row["render ms"] / 1e3),
            seconds(row["render v+g ms"] / 1e3),
            machine(compositor),
            link(page, "compositor"),
        )
        for row in compositor["rows"]
    ]
    for data in (scaling, gpu):
        largest = row_of(data, Gaussians=1_000_000, width=1280, room=1, cameras=1)
        rows.append(
            (
                "a synthetic million, 1280 × 720",
                seconds(largest["forward ms"] / 1e3),
                seconds(largest["v+g ms"] / 1e3),
                machine(data),
                link(page, "scaling"),
            )
        )
    return rows


def compositing(page: Path) -> list[Row]:
    """Return the compositor's time relative to C++."""
    data = result("compositor")
    return [
        (
            row["scene"].removesuffix("_run"),
            f"{row['forward / C++']:.2f} ×",
            f"{row['composite v+g ms'] / row['C++ v+g plain ms']:.2f} ×",
            f"{row['composite v+g ms'] / row['C++ v+g tuned ms']:.2f} ×",
            machine(data),
            link(page, "compositor"),
        )
        for row in data["rows"]
    ]


def training(page: Path) -> list[Row]:
    """Return the held-out quality at the end of a run."""
    rows = []
    for name, capture in (
        ("training_banana", "bananas, 15 photos"),
        ("training_kermit", "kermit, 11 photos"),
        ("training_kermit_gpu", "kermit, 11 photos"),
    ):
        data = result(name)
        for strategy in ("mcmc", "adaptive"):
            runs = [r for r in data["rows"] if r["strategy"] == strategy]
            if runs:
                last = runs[-1]
                rows.append(
                    (
                        capture,
                        strategy,
                        f"{last['psnr']:.1f} dB",
                        f"{last['ssim']:.3f}",
                        f"{last['gaussians']:,}",
                        seconds(last["seconds"]),
                        machine(data),
                        link(page, "training"),
                    )
                )
    return rows


def compression(page: Path) -> list[Row]:
    """Return the sizes of compressed scenes at a loss of 0.3 dB, and of others."""
    data = result("rate_distortion")
    rows = []
    for name in dict.fromkeys(row["scene"] for row in data["rows"]):
        some = [row for row in data["rows"] if row["scene"] == name]

        def size(way: str, goal: str, some=some) -> str:
            found = [r for r in some if r["way"] == way and goal in r["goal"]]
            return f"{found[0]['bytes'] / 1e6:.2f} MB" if found else "–"

        rows.append(
            (
                f"{name}, degree {some[0]['degree']}",
                f"{some[0]['Gaussians']:,}",
                size("plain PLY", ""),
                size("splat-transform .sog", ""),
                size("gsjax .sog", "foreign"),
                size("gsjax .sog", "0.3 dB"),
                size("gsjax .sog, 300 steps", "0.3 dB"),
                machine(data),
                link(page, "rate_distortion"),
            )
        )
    return rows


TABLES = {
    "headline": (headline, ("what", "result", "machine", "program")),
    "rendering": (
        rendering,
        ("scene", "image", "value and gradient", "machine", "program"),
    ),
    "compositing": (
        compositing,
        ("scene", "image", "v+g, plain", "v+g, tuned", "machine", "program"),
    ),
    "training": (
        training,
        (
            *("capture", "strategy", "PSNR", "SSIM", "Gaussians", "time"),
            *("machine", "program"),
        ),
    ),
    "compression": (
        compression,
        (
            *("scene", "Gaussians", "PLY", "splat-transform", "gsjax, equal loss"),
            *("0.3 dB lost", "fine-tuned", "machine", "program"),
        ),
    ),
}


def table(name: str, page: Path) -> str:
    """Return a table as Markdown.

    Args:
      name: a key of `TABLES`.
      page: the page that it is for.
    """
    rows, head = TABLES[name]
    lines = [head, ("---",) * len(head), *rows(page)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def updated(page: Path) -> str:
    """Return the text of a page with its tables generated anew."""
    return _BLOCK.sub(
        lambda found: found[1] + table(found[2], page) + found[3],
        page.read_text(encoding="utf-8"),
    )


def main() -> int:
    """Rewrite the pages, or check them."""
    stale = [p for p in PAGES if updated(p) != p.read_text(encoding="utf-8")]
    if "--check" in sys.argv:
        for page in stale:
            print(f"{page.relative_to(ROOT)}: out of date; run docs/numbers.py")
        return int(bool(stale))
    for page in stale:
        page.write_text(updated(page), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
