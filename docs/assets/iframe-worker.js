// From a disk, browsers start no workers, and the search of these pages is one. There a
// hidden frame does its work, in the page's own thread. (Material's plugin `offline` would
// fetch a script of this name, which does the same, from the network.)
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.append(frame);
      this.inside = frame.contentWindow;
      this.inside.document.open();
      this.inside.document.write("<body>");
      this.inside.document.close();
      this.inside.postMessage = (data) =>
        this.dispatchEvent(new MessageEvent("message", { data }));
      const script = this.inside.document.createElement("script");
      this.ready = new Promise((resolve) => (script.onload = resolve));
      script.src = url;
      this.inside.document.body.append(script);
    }
    postMessage(data) {
      const told = new MessageEvent("message", { data });
      this.ready.then(() => this.inside.dispatchEvent(told));
    }
  };
}
