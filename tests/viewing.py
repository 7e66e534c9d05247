"""Shared by the tests of the viewer: a scene, stand-ins for browsers, and Chromium."""

import base64
import json
import shutil
import subprocess
import threading
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import jax
import numpy as np
import training
from captures import save_photo
from conftest import frustum_points, gaussians_at

from gsjax.data.colmap_writer import write_colmap
from gsjax.runs.folder import RunSettings, load_split, save_settings, with_views
from gsjax.train.config import TrainConfig

COUNT = 64
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


def chromium(profile: Path, *more: str) -> list[str]:
    """Return the command of a browser with a profile of its own."""
    webgl = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    command = [str(CHROMIUM), "--headless", "--no-sandbox", *webgl]
    return [*command, "--ignore-gpu-blocklist", f"--user-data-dir={profile}", *more]


def wait_for(condition, seconds=30.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def scene(spread=1.0, degree=1):
    """Orange Gaussians of all sizes and opacities; ``spread`` is their scale."""
    rng = np.random.default_rng(0)
    points = spread * frustum_points(rng, COUNT)
    scales = spread * np.exp(rng.normal(-2.0, 0.7, (COUNT, 3)))
    found = gaussians_at(points, scales, rng.uniform(0.02, 0.99, COUNT), degree=degree,
                         viewmat=np.eye(4))  # fmt: skip
    sh = np.zeros_like(found.params.sh)
    sh[:, 0] = (np.array([0.9, 0.5, 0.1]) - 0.5) / 0.28209479177387814
    return found.replace(params=found.params.replace(sh=jax.numpy.asarray(sh)))


PHOTO_COLORS = np.array([[200, 40, 30], [30, 180, 60], [40, 60, 190], [120, 120, 120]])


def run_at(folder: Path, config: TrainConfig, **changes) -> Path:
    """A run before its first step, on the small capture with these changes; each
    photograph has one colour, 320 × 240 px.
    """
    made = replace(training.dataset(), **changes)
    write_colmap(folder / "data" / "sparse" / "0", made)
    for view, color in zip(made.views, PHOTO_COLORS, strict=True):
        photo = np.full((240, 320, 3), color, np.uint8)
        save_photo(folder / "data" / "images" / view.name, photo)
    settings = RunSettings(folder / "data", config, every=0)
    run = folder / "run"
    run.mkdir()
    save_settings(run, with_views(settings, load_split(settings)))
    return run


CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 0.0), "fov": 0.7, "image_height": 24,
    "image_width": 32, "near": 0.01, "far": 100.0, "look_at": (0.0, 0.0, 1.0),
    "up_direction": (0.0, -1.0, 0.0),
}  # fmt: skip


class Browser:
    """Connects as a browser does and sends its camera, but draws nothing."""

    def __init__(self, url: str):
        import msgspec
        import viser
        from websockets.sync.client import connect

        self.socket = connect(
            url.replace("http", "ws"),
            subprotocols=[f"viser-v{viser.__version__}"],
            max_size=None,
        )
        self.encode = msgspec.msgpack.encode
        self.socket.send(self.encode(CAMERA))
        self.received: list[bytes] = []
        read = lambda: self.received.extend(self.socket)  # noqa: E731
        self.reader = threading.Thread(target=read, daemon=True)
        self.reader.start()

    def splat_counts(self) -> list[int]:
        """Return the numbers of splats of each message about them."""
        import msgspec
        import zstandard

        counts = []
        for data in list(self.received):
            size = int.from_bytes(data[8:16], "little")
            packed = zstandard.ZstdDecompressor().decompress(data[16 : 16 + size])
            window = msgspec.msgpack.decode(packed)
            lengths = window["binaryBufferLengths"]
            for message in window["messages"]:
                if message["type"] == "GaussianSplatsMessage":
                    index = message["props"]["buffer"]["__binary_index"]
                    counts.append(lengths[index] // 32)
        return counts

    def look_from(self, position) -> None:
        """Send a camera at this position."""
        position = tuple(map(float, position))
        self.socket.send(self.encode(CAMERA | {"position": position}))

    def click(self, session, name: str) -> None:
        """Click on a node of its own scene."""
        click = {
            "type": "SceneNodeClickMessage", "name": name, "instance_index": None,
            "ray_origin": (0.0, 0.0, 0.0), "ray_direction": (0.0, 0.0, 1.0),
            "screen_pos": (0.5, 0.5), "modifier": None,
            "owner": str(session.client.client_id),
        }  # fmt: skip
        self.socket.send(self.encode(click))

    def close(self) -> None:
        self.socket.close()
        self.reader.join(10)


def page_requests(url: str, folder: Path) -> tuple[str, list[str]]:
    """Load a page in Chromium: its HTML after twenty seconds of virtual time, and all
    addresses that it requested from the network.
    """
    # With virtual time Chromium hangs, once in some thirty times.
    for attempt in range(3):
        log = folder / f"net{attempt}.json"
        options = (f"--log-net-log={log}", "--virtual-time-budget=20000", "--dump-dom")
        command = chromium(folder / f"profile{attempt}", *options, url)
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=60)
            break
        except subprocess.TimeoutExpired:
            continue
    else:
        raise TimeoutError(f"{url}: Chromium hangs")
    events = [one.get("params", {}) for one in json.loads(log.read_text())["events"]]
    # Chromium's own requests have no origin.
    asked = {
        one["url"]
        for one in events
        if one.get("initiator", "not an origin") != "not an origin"
    }
    here = ("file:", "data:", "blob:")
    return done.stdout, sorted(url for url in asked if not url.startswith(here))


def screenshots(url: str, profile: Path, size: str = "500,400") -> Iterator[np.ndarray]:
    """Screenshots [H, W, 3] of a page in Chromium, one after another.

    A script sent to the generator runs in the page before the next one. Closing the
    generator ends Chromium.
    """
    from websockets.sync.client import connect

    options = ("--remote-debugging-port=0", f"--window-size={size}", url)
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    browser = subprocess.Popen(chromium(profile, *options), **quiet)
    try:
        port = profile / "DevToolsActivePort"
        wait_for(lambda: port.exists() and port.read_text())
        address = f"http://127.0.0.1:{port.read_text().split()[0]}/json"
        targets = json.loads(urllib.request.urlopen(address, timeout=30).read())
        (target,) = (one for one in targets if one["type"] == "page")
        with connect(target["webSocketDebuggerUrl"], max_size=None) as socket:

            def ask(method: str, **params) -> dict:
                socket.send(json.dumps({"id": 0, "method": method, "params": params}))
                return json.loads(socket.recv(timeout=60))["result"]

            while True:
                data = base64.b64decode(ask("Page.captureScreenshot")["data"])
                picture = cv2.imdecode(np.frombuffer(data, np.uint8), 1)[..., ::-1]
                script = yield picture
                if script is not None:
                    ask("Runtime.evaluate", expression=script)
    finally:
        browser.kill()
        browser.wait()
