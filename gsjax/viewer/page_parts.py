"""Pages that show the most important Gaussians while the others load.

viser embeds a recording of all messages in a page, and starts when the page is
complete. Here the recording holds the first part only, viser starts as soon as that is
loaded, and the messages of later parts are appended to its queue as they arrive.
"""

import base64
import gzip
import json
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gsjax.viewer.viser_server import require_viser

# NumPy's names of the types in messages, and JavaScript's of their arrays.
_ARRAYS = {"<u4": "Uint32Array", "<f4": "Float32Array", "|u1": "Uint8Array"}
_ALIGNMENT = 8  # bytes

# Later splats of this name are kept for scripts of the page, not shown.
KEPT = "/moment"

# To be placed before viser's program, which waits for DOMContentLoaded. The recording
# hides what precedes it, and `firstMessageBatch` is false as soon as it is played.
HEAD = """<script>
(() => {
  const listen = document.addEventListener.bind(document), waiting = [];
  let started = false, last = Promise.resolve();
  const start = () => {
    started = true;
    for (const listener of waiting.splice(0)) listener();
  };
  document.addEventListener = (kind, listener, ...options) => {
    if (kind !== "DOMContentLoaded") listen(kind, listener, ...options);
    else if (started) listener();
    else waiting.push(listener);
  };
  listen("DOMContentLoaded", () => { delete document.addEventListener; start(); });
  const pause = () => new Promise((done) => setTimeout(done, 20));
  const decode = (text) => Uint8Array.fromBase64?.(text) ??
    Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const apply = async (messages, data) => {
    const stream = new Blob([decode(data)]).stream();
    const plain = stream.pipeThrough(new DecompressionStream("gzip"));
    const bytes = await new Response(plain).arrayBuffer();
    const added = JSON.parse(messages, (_, value) => value?.array === undefined ? value
      : new globalThis[value.array](bytes, value.offset, value.length));
    while (window.__viserMutable?.firstMessageBatch !== false) await pause();
    const { kept } = window.gsjaxParts, queue = window.__viserMutable.messageQueue;
    for (const one of added) {
      if (one.name !== "{kept}") queue.push(one);
      else if (one.props?.buffer) kept.push(one);
    }
    window.__viserMutable.requestRender();
  };
  const tell = (text) => {
    document.getElementById("gsjax-loading").textContent = text;
  };
  window.gsjaxParts = {
    start,
    kept: [],
    add: (messages, data, text) => {
      last = last.then(() => apply(messages, data)).then(() => tell(text));
      last.catch((error) => tell(` The rest cannot be shown: ${error}.`));
    },
  };
})();
</script>""".replace("{kept}", KEPT)
START = "<script>gsjaxParts.start()</script>"
STATUS = '<span id="gsjax-loading" style="display:block">{}</span>'


def parts_are_possible() -> bool:
    """Return whether the installed viser exposes its queue of messages.

    Raises:
      MissingExtraError: if viser is absent.
    """
    source = Path(require_viser().__file__).parent / "client" / "src" / "App.tsx"
    return source.exists() and "__viserMutable" in source.read_text("utf-8")


def record(server: Any, steps: Sequence[tuple[Callable[[], object], str]]) -> list[str]:
    """Return scripts that bring the messages of each step to a page, in order.

    Args:
      server: a `viser.ViserServer`, whose state is that of the page before.
      steps: a function that adds to its scene, and the status to be shown afterwards.
    """
    import msgspec
    import zstandard

    recorder = server.get_scene_serializer()
    for add, _ in steps:
        recorder.insert_sleep(1.0)  # tells the steps apart
        add()
    # A size, and compressed: another size, messages, and the arrays that they refer to.
    raw = zstandard.ZstdDecompressor().decompress(recorder.serialize()[8:])
    end = 8 + struct.unpack("<Q", raw[:8])[0]
    recording = msgspec.msgpack.decode(raw[8:end])
    arrays = []
    for size in recording["binaryBufferLengths"]:
        start = end + -end % _ALIGNMENT
        end = start + size
        arrays.append(memoryview(raw)[start:end])
    scripts = []
    for index, (_, status) in enumerate(steps, start=1):
        messages = [m for time, m in recording["messages"] if round(time) == index]
        scripts.append(_script(messages, arrays, status))
    return scripts


def _script(messages: list[dict], arrays: list[memoryview], status: str) -> str:
    """Return a script with the messages; their arrays are in one compressed string."""
    data = bytearray()

    def stored(content: bytes | memoryview, dtype: str) -> dict:
        data.extend(bytes(-len(data) % _ALIGNMENT))
        place = len(data)
        data.extend(content)
        count = len(content) // int(dtype[-1])
        return {"array": _ARRAYS[dtype], "offset": place, "length": count}

    def encoded(value):
        if isinstance(value, bytes):
            return stored(value, "|u1")
        if isinstance(value, dict) and "__binary_index" in value:
            return stored(arrays[value["__binary_index"]], value["dtype"])
        if isinstance(value, dict):
            return {key: encoded(one) for key, one in value.items()}
        return [encoded(one) for one in value] if isinstance(value, list) else value

    texts = json.dumps([encoded(message) for message in messages]), status
    literals = [json.dumps(text).replace("<", "\\u003c") for text in texts]
    packed = base64.b64encode(gzip.compress(bytes(data), 6, mtime=0)).decode()
    return f'<script>gsjaxParts.add({literals[0]}, "{packed}", {literals[1]})</script>'
