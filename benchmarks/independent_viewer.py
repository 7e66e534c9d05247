"""Claim: another program shows exported scenes as gsjax does.

``python benchmarks/independent_viewer.py RUN...`` exports runs as PLY and SPZ, opens
the files in GaussianSplats3D (Kellogg, MIT; WebGL) with the camera of a photograph, and
renders the same view with gsjax. It saves both side by side, of the PLY of the last
run, and their difference. (That viewer has 8-bit colours, cuts splats at √8 standard
deviations, drops α below 1/255, and reads SPZ of version 2, as which the file is
rewritten.) Scenes of ``--mip`` are drawn with the viewer's
own antialiasing and a kernel of 0.1 px². It needs ``npm``, which downloads the viewer,
and Chromium.
"""

from __future__ import annotations

import argparse
import base64
import functools
import gzip
import http.server
import json
import struct
import subprocess
import tempfile
import threading
from pathlib import Path
from typing import ClassVar

import as_cli  # noqa: F401
import cv2
import measure
import numpy as np

import gsjax
from gsjax.runs.export import export_scene
from gsjax.runs.folder import load_settings, load_split
from gsjax.runs.scene_source import file_raster
from gsjax.runs.trajectories import view_entries

PACKAGES = ("@mkkellogg/gaussian-splats-3d@0.4.7", "three@0.167.1")
PATIENCE = 300.0  # s; the browser renders without a GPU

PAGE = """<!doctype html><meta charset="utf-8"><body style="margin:0">
<script type="importmap">{"imports": {
  "three": "./node_modules/three/build/three.module.js", "splats":
  "./node_modules/@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js"
}}</script>
<script type="module">
import * as THREE from "three";
import * as Splats from "splats";
const tell = (path, body) => fetch(path, {method: "POST", body});
window.onerror = (text) => tell("/error", String(text));
window.onunhandledrejection = (event) => tell("/error", String(event.reason));
const told = await (await fetch("view.json")).json();
const {width, height, projection, pose, degree, name, antialiased, kernel} = told;
const renderer = new THREE.WebGLRenderer(
  {antialias: false, preserveDrawingBuffer: true});
renderer.setPixelRatio(1);
renderer.setSize(width, height);
renderer.setClearColor(0, 1);
document.body.appendChild(renderer.domElement);
const camera = new THREE.PerspectiveCamera();
camera.matrixAutoUpdate = false;
camera.matrix.fromArray(pose);
camera.matrix.decompose(camera.position, camera.quaternion, camera.scale);
camera.updateMatrixWorld(true);
camera.projectionMatrix.fromArray(projection);
camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
const viewer = new Splats.DropInViewer({
  sharedMemoryForWorkers: false, gpuAcceleratedSort: false, integerBasedSort: false,
  sphericalHarmonicsDegree: degree, antialiased, kernel2DSize: kernel,
  dynamicScene: false,
  sceneRevealMode: Splats.SceneRevealMode.Instant, logLevel: 0});
const scene = new THREE.Scene();
scene.add(viewer);
await viewer.addSplatScene(name, {showLoadingUI: false,
  splatAlphaRemovalThreshold: 1, progressiveLoad: false});
const pause = (ms) => new Promise((done) => setTimeout(done, ms));
for (let frame = 0; frame < 30; frame++) {
  renderer.render(scene, camera);
  await pause(200);
}
await tell("/picture", renderer.domElement.toDataURL("image/png"));
</script>"""


class Handler(http.server.SimpleHTTPRequestHandler):
    """Serve a folder and keep what the page posts."""

    posted: ClassVar[dict[str, bytes]] = {}
    done = threading.Event()

    def do_POST(self):
        """Keep the body by its path."""
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.posted[self.path] = body
        self.send_response(204)
        self.end_headers()
        self.done.set()

    def log_message(self, format, *args):
        """Print nothing."""


def theirs(
    folder: Path,
    splat: Path,
    camera: gsjax.Camera,
    origin,
    degree: int,
    raster: gsjax.RasterConfig,
):
    """Return the image [H, W, 3] uint8 of the other program."""
    Handler.posted.clear()
    Handler.done.clear()
    packages = ["npm", "install", "--no-audit", "--no-fund", *PACKAGES]
    subprocess.run(packages, cwd=folder, check=True, capture_output=True)
    (folder / "index.html").write_text(PAGE, encoding="utf-8")
    viewmat, K = (np.asarray(a, np.float64) for a in (camera.viewmat, camera.K))
    pose = np.linalg.inv(viewmat)
    pose[:3, 3] += origin
    pose[:3, 1:3] *= -1  # y up, looking along −z
    if splat.suffix == ".spz":  # whose axes are ours after half a turn about x
        pose = np.diag([1.0, -1.0, -1.0, 1.0]) @ pose
    near, far = 0.01, 1000.0
    (fx, cx), (fy, cy) = (K[0, 0], K[0, 2]), (K[1, 1], K[1, 2])
    width, height = camera.width, camera.height
    projection = np.array([
        [2 * fx / width, 0, 1 - 2 * cx / width, 0],
        [0, 2 * fy / height, 2 * cy / height - 1, 0],
        [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
        [0, 0, -1, 0],
    ])  # fmt: skip
    view = {
        "width": width, "height": height, "degree": min(degree, 2), "name": splat.name,
        "antialiased": raster.antialias, "kernel": raster.dilation,
        "projection": projection.T.ravel().tolist(), "pose": pose.T.ravel().tolist(),
    }  # fmt: skip
    (folder / "view.json").write_text(json.dumps(view), encoding="utf-8")
    handler = functools.partial(Handler, directory=str(folder))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    browser = subprocess.Popen(
        [
            "chromium", "--headless=new", "--no-sandbox", "--use-gl=angle",
            "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
            f"--user-data-dir={folder / 'profile'}", "--disable-gpu-sandbox",
            f"http://127.0.0.1:{server.server_port}/index.html",
        ],
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        assert Handler.done.wait(PATIENCE), "the page has sent nothing"
    finally:
        browser.kill()
        browser.wait()
        server.shutdown()
    assert "/error" not in Handler.posted, Handler.posted["/error"].decode()
    png = base64.b64decode(Handler.posted["/picture"].split(b",", 1)[1])
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def as_version_2(path: Path) -> None:
    """Rewrite an SPZ file for readers of version 2: rotations of 24 bits, in place."""
    raw = bytearray(gzip.decompress(path.read_bytes()))
    (count,) = struct.unpack_from("<I", raw, 8)
    quats = np.asarray(gsjax.load(path).params.quats, np.float64)
    xyz = quats[:, 1:] * [1, -1, -1] * np.where(quats[:, :1] < 0, -1, 1)
    start = 16 + 16 * count  # after means, opacities, colours and scales
    packed = np.clip(np.rint(127.5 * (1 + xyz)), 0, 255).astype(np.uint8)
    raw[start : start + 4 * count] = packed.tobytes()
    struct.pack_into("<I", raw, 4, 2)
    path.write_bytes(gzip.compress(raw))


def compared(run: Path, suffix: str) -> tuple[dict, np.ndarray]:
    """Return how far both are apart, and both images side by side."""
    settings = load_settings(run)
    split = load_split(settings)
    size = settings.config.max_size
    entry = view_entries(split.views("train"), max_size=size)[0]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file = folder / f"splat{suffix}"
        export_scene(run, file)
        if suffix == ".spz":
            as_version_2(file)
        raster = file_raster(file)
        gaussians = gsjax.load(file)
        degree, origin = gaussians.sh_degree, split.dataset.origin
        found = theirs(folder, file, entry.camera, origin, degree, raster)
    scene = gaussians.replace(
        params=gaussians.params.replace(
            means=gaussians.params.means - origin.astype(np.float32)
        )
    )
    view = gsjax.render_exact(scene, entry.camera, raster)
    ours = np.rint(255 * np.clip(np.asarray(view.rgb), 0, 1)).astype(np.uint8)
    apart = ours.astype(np.float64) - found
    row = {
        "run": run.name,
        "mip": settings.config.mip,
        "file": suffix,
        "view": entry.name,
        "size": f"{entry.camera.width} x {entry.camera.height}",
        "Gaussians": int(gsjax.num_active(gaussians)),
        "PSNR of one against the other, dB": float(
            -10 * np.log10(np.mean(apart**2) / 255**2)
        ),
        "mean difference /255": float(apart.mean()),
        "99 % of pixels within /255": float(np.percentile(np.abs(apart), 99)),
    }
    return row, np.concatenate([ours, found], 1)


def main() -> None:
    """Render both, compare and save."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    rows = []
    for run in parser.parse_args().runs:
        for suffix in (".spz", ".ply"):
            row, both = compared(run, suffix)
            rows.append(row)
            print(row)
    path = measure.RESULTS / "independent_viewer.webp"
    cv2.imwrite(str(path), both[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, 90])
    measure.save("independent_viewer", rows, claim=__doc__, packages=PACKAGES)


if __name__ == "__main__":
    main()
