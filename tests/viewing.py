"""What the tests of the viewer share: a scene, patience, and pages in Chromium."""

import json
import shutil
import subprocess
import time
from pathlib import Path

import jax
import numpy as np
from conftest import frustum_points, gaussians_at

COUNT = 64
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
WEBGL = [
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"
]  # fmt: skip


def wait_for(condition, seconds=30.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def scene(spread=1.0, degree=1):
    """Gaussians of all sizes and opacities, orange, as large as ``spread``."""
    rng = np.random.default_rng(0)
    points = spread * frustum_points(rng, COUNT)
    scales = spread * np.exp(rng.normal(-2.0, 0.7, (COUNT, 3)))
    found = gaussians_at(points, scales, rng.uniform(0.02, 0.99, COUNT), degree=degree,
                         viewmat=np.eye(4))  # fmt: skip
    sh = np.zeros_like(found.params.sh)
    sh[:, 0] = (np.array([0.9, 0.5, 0.1]) - 0.5) / 0.28209479177387814
    return found.replace(params=found.params.replace(sh=jax.numpy.asarray(sh)))


def opened(url: str, folder: Path) -> tuple[str, list[str]]:
    """A page in Chromium after twenty seconds of its own time: what has become of its
    HTML, and all that it asked the network for.
    """
    # On a clock of its own Chromium hangs, once in some thirty times.
    for attempt in range(3):
        log = folder / f"net{attempt}.json"
        command = [
            str(CHROMIUM), "--headless", "--no-sandbox", *WEBGL,
            f"--user-data-dir={folder / f'profile{attempt}'}", f"--log-net-log={log}",
            "--virtual-time-budget=20000", "--dump-dom", url,
        ]  # fmt: skip
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=60)
            break
        except subprocess.TimeoutExpired:
            continue
    else:
        raise TimeoutError(f"{url}: Chromium hangs")
    events = [one.get("params", {}) for one in json.loads(log.read_text())["events"]]
    # What Chromium asks for by itself is of no origin.
    asked = {
        one["url"]
        for one in events
        if one.get("initiator", "not an origin") != "not an origin"
    }
    here = ("file:", "data:", "blob:")
    return done.stdout, sorted(url for url in asked if not url.startswith(here))
