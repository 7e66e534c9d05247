"""HTML pages of `gsjax view --html`, and the arguments of the command."""

import base64
import gzip
import json
import re
import struct
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
import training
from viewing import COUNT, PHOTO_COLORS, run_at, scene

import gsjax
from gsjax.cli.main import main
from gsjax.math.rotations import quaternion_to_matrix
from gsjax.runs.folder import run_files, save_scene
from gsjax.train.config import TrainConfig
from gsjax.viewer.cameras import UPS

pytest.importorskip("viser", reason="needs gsjax[viewer]")

FAR = np.asarray([4e5, -3e6, 20.0])


@pytest.fixture(scope="module")
def ply(tmp_path_factory):
    """A scene of which three Gaussians are too faint to be drawn."""
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    logits = scene().params.logit_opacities.at[:3].set(-9.0)
    params = scene().params.replace(logit_opacities=logits)
    gsjax.save(path, scene().replace(params=params))
    return path


def decode(text: str) -> tuple[list[dict], np.ndarray]:
    """Messages of a page, and its packed splats [M, 8]: its only buffer."""
    import msgspec
    import zstandard

    data = base64.b64decode(re.search(r'EMBED_DATA__="([^"]*)"', text)[1])
    inner = zstandard.ZstdDecompressor().decompressobj().decompress(data[8:])
    length = 8 + struct.unpack("<Q", inner[:8])[0]
    content = msgspec.msgpack.decode(inner[8:length])
    messages = [message for _, message in content["messages"]]
    kinds = [message["type"] for message in messages]
    assert kinds.count("GaussianSplatsMessage") == 1
    assert "BackgroundImageMessage" in kinds
    (size,) = content["binaryBufferLengths"]
    packed = np.frombuffer(inner[len(inner) - size :], np.uint32).reshape(-1, 8)
    return messages, packed


def later(text: str) -> list[list[dict]]:
    """Messages of the parts that follow, with arrays as a browser decodes them."""
    found = []
    for call in re.findall(r"<script>gsjaxParts\.add\((.*?)\)</script>", text):
        messages, data, _ = json.loads(f"[{call}]")
        raw = gzip.decompress(base64.b64decode(data))

        def revived(value, raw=raw):
            if "array" not in value:
                return value
            kind = {"Uint32Array": np.uint32, "Uint8Array": np.uint8}[value["array"]]
            return np.frombuffer(raw, kind, value["length"], value["offset"])

        found.append(json.loads(messages, object_hook=revived))
    return found


def splats_of(props: dict, packed: np.ndarray) -> np.ndarray:
    """Means in world units, and colours with opacities [M, 7]."""
    means = packed[:, :3].copy().view(np.float32) * props["scale"]
    rgba = packed[:, 7:].copy().view(np.uint8)
    return np.concatenate([means, rgba], axis=1)


def about(messages: list[dict], kind: str, name: str) -> dict:
    """The only message of a kind about a node of the scene."""
    (found,) = (m for m in messages if m["type"] == kind and m["name"] == name)
    return found


def turned(wxyz) -> np.ndarray:
    return np.asarray(quaternion_to_matrix(np.asarray(wxyz)))


def test_without_viser_the_error_names_the_package(ply, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    page = ["export", str(ply), str(tmp_path / "a.html")]
    training = ["train", "x", "-o", str(tmp_path), "--viewer"]
    for args in (["view", str(ply)], page, training):
        assert main(args) == 6
        out, err = capsys.readouterr()
        assert out == ""
        assert "install it: pip install viser" in err


def test_a_page_holds_the_scene_and_loads_nothing(ply, tmp_path, capsys):
    out = tmp_path / "new" / "a.html"
    assert main(["view", str(ply), "--html", str(out)]) == 0
    said = capsys.readouterr()
    size = out.stat().st_size / 2**20
    drawn = COUNT - 3
    assert said.out == f"{out}  {drawn} of {COUNT} Gaussians, {size:.2f} MiB\n"
    assert f"3 of {COUNT} Gaussians left out: opacity below 0.01" in said.err
    text = out.read_text()
    assert not re.findall(r"(?:src|href)=.?https?://[^\"' ]+", text)
    assert "SH degree 0" in text
    _, packed = decode(text)
    rgb = packed[:, 7:].copy().view(np.uint8)[:, :3] / 255
    np.testing.assert_allclose(rgb, [[0.9, 0.5, 0.1]] * drawn, atol=1 / 255)
    assert main(["view", str(ply), "--html", str(out)]) == 3
    assert "exists" in capsys.readouterr().err
    for args in (["--min-opacity", "1"], ["--max-gaussians", "0"]):
        assert main(["view", str(ply), *args]) == 2
        assert args[0] in capsys.readouterr().err
    args = ["--overwrite", "--max-gaussians", "20", "--min-opacity", "0.5"]
    assert main(["view", str(ply), "--html", str(out), *args]) == 0
    said = capsys.readouterr()
    assert f"20 of {COUNT} Gaussians" in said.out
    assert "left out" not in said.err, "the limit was requested"
    args = ["--overwrite", "--min-opacity", "0.999"]
    assert main(["view", str(ply), "--html", str(out), *args]) == 3
    assert "lower --min-opacity" in capsys.readouterr().err


def test_export_writes_the_page_of_view(ply, tmp_path, capsys):
    pages, said = [tmp_path / "a.html", tmp_path / "b.HTM"], []
    for words in (["view", ply, "--html", pages[0]], ["export", ply, pages[1]]):
        assert main([*map(str, words), "--min-opacity", "0.2"]) == 0
        out, err = capsys.readouterr()
        said.append((out.split("  ")[1], err))
    assert said[0] == said[1]
    assert "Gaussians left out: opacity below 0.2" in said[0][1]
    assert pages[0].read_text() == pages[1].read_text()
    again = ["export", str(ply), str(pages[1])]
    for more, code, message in (
        ([], 3, "b.HTM: exists; pass --overwrite"),
        (["--overwrite", "--sh-degree", "1"], 2, "a page has one colour"),
        (["--overwrite", "--min-opacity", "0.999"], 3, "lower --min-opacity"),
    ):
        assert main([*again, *more]) == code
        assert message in capsys.readouterr().err
        assert pages[0].read_text() == pages[1].read_text()
    assert main([*again, "--overwrite", "--sh-degree", "0"]) == 0


@pytest.mark.parametrize("parts", [2, 3])
def test_the_parts_of_a_page_are_the_whole(tmp_path, capsys, parts):
    """The most important Gaussians come first, cameras and photographs last."""
    run = run_at(tmp_path, TrainConfig())
    gaussians = training.true_gaussians()
    save_scene(run_files(run).splat, gaussians, training.dataset(), TrainConfig())
    texts = []
    for count in (1, parts):
        out = tmp_path / f"{count}.html"
        words = ["view", run, "--html", out, "--parts", count]
        assert main(list(map(str, words))) == 0
        texts.append(out.read_text())
    whole, packed = decode(texts[0])
    first, some = decode(texts[1])
    added = later(texts[1])
    assert len(added) == parts - 1
    assert later(texts[0]) == []
    shares = [some.shape[0]]
    expected = splats_of(
        about(whole, "GaussianSplatsMessage", "/splats")["props"], packed
    )
    found = [splats_of(about(first, "GaussianSplatsMessage", "/splats")["props"], some)]
    for index, messages in enumerate(added, start=2):
        name = f"/splats-{index}"
        props = about(messages, "GaussianSplatsMessage", name)["props"]
        found.append(splats_of(props, props["buffer"].reshape(-1, 8)))
        shares.append(len(found[-1]))
    rows = [each[np.lexsort(each.T)] for each in (np.concatenate(found), expected)]
    np.testing.assert_allclose(*rows, rtol=1e-6)
    assert shares[0] == round(0.1 * len(expected))
    assert sorted(shares) == shares
    names = [m["name"] for m in first if "CameraFrustum" in m["type"]]
    assert names == []
    for index in range(training.VIEWS):
        name = f"/cameras/{index:04d}"
        photos = [
            about(messages, "CameraFrustumMessage", name)["props"]["_image_data"]
            for messages in (whole, added[-1])
        ]
        assert bytes(photos[0]) == bytes(photos[1])
    assert main(["view", str(run), "--parts", "2"]) == 2
    assert "--parts goes with --html" in capsys.readouterr().err


def test_a_page_of_a_run_holds_its_cameras_and_photographs(tmp_path, capsys):
    """Far from the origin; up is +y in the browser, by default that of the cameras."""
    run = run_at(tmp_path, TrainConfig(), origin=FAR)
    far = replace(training.dataset(), origin=FAR)
    save_scene(run_files(run).splat, training.true_gaussians(), far, TrainConfig())
    sizes = []
    for up in (None, "+x", "-y"):
        out = tmp_path / f"{up}.html"
        more = ["--no-photos", "--up", up] if up else []
        assert main(["view", str(run), "--html", str(out), *more]) == 0
        said = capsys.readouterr()
        assert f"{training.POINTS} Gaussians, {training.VIEWS} cameras" in said.out
        assert "warning" not in said.err
        sizes.append(out.stat().st_size)
        messages, packed = decode(out.read_text())
        world = turned(about(messages, "SetOrientationMessage", "")["wxyz"])
        np.testing.assert_allclose(world @ UPS[up or "+z"], (0, 1, 0), atol=1e-6)
        splats = about(messages, "GaussianSplatsMessage", "/splats")["props"]
        means = packed[:, :3].copy().view(np.float32) * splats["scale"]
        # The origin of the page is arbitrary.
        away = np.median(means - training.true_gaussians().params.means, axis=0)
        for index, view in enumerate(training.dataset().views):
            name = f"/cameras/{index:04d}"
            place = about(messages, "SetPositionMessage", name)["position"]
            np.testing.assert_allclose(place - away, view.centre, atol=1e-4)
            turn = turned(about(messages, "SetOrientationMessage", name)["wxyz"])
            np.testing.assert_allclose(turn, view.viewmat[:3, :3].T, atol=1e-6)
            drawn = about(messages, "CameraFrustumMessage", name)["props"]
            half = np.tan(drawn["fov"] / 2)
            np.testing.assert_allclose(half, view.height / 2 / view.K[1, 1])
            np.testing.assert_allclose(drawn["aspect"], view.width / view.height)
            if up:
                assert drawn["_image_data"] is None
                continue
            photo = cv2.imdecode(np.frombuffer(drawn["_image_data"], np.uint8), 1)
            assert photo.shape == (120, 160, 3)
            assert np.abs(photo[..., ::-1] - PHOTO_COLORS[index].astype(int)).max() < 8
    assert sizes[1] < sizes[0]
