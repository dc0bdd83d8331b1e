/* The search where the site is read from a disk: browsers start no worker from a file, so its script
   runs in a hidden frame that answers to the same calls. Where there is a server this does nothing. */
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.onmessage = null;
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.appendChild(frame);
      const inner = frame.contentWindow;
      this.inner = inner;
      /* What the worker says comes to this window, and is handed on as the worker's. */
      window.addEventListener("message", event => {
        if (event.source !== inner) return;
        const message = new MessageEvent("message", { data: event.data });
        this.dispatchEvent(message);
        if (this.onmessage) this.onmessage(message);
      });
      const page = inner.document;
      page.open();
      page.write(`<!doctype html><script>
        var postMessage = data => parent.dispatchEvent(
          new MessageEvent("message", { data, source: window }));
        var importScripts = (...urls) => urls.reduce((before, url) => before.then(() =>
          new Promise((resolve, reject) => {
            const script = document.createElement("script");
            script.src = url; script.onload = resolve; script.onerror = reject;
            document.body.appendChild(script);
          })), Promise.resolve());
        <\/script><body><script src="${new URL(url, location).href}"><\/script></body>`);
      page.close();
      this.loaded = new Promise(resolve => frame.addEventListener("load", resolve, { once: true }));
    }
    postMessage(data) {
      this.loaded.then(() => this.inner.dispatchEvent(new MessageEvent("message", { data })));
    }
    terminate() { this.inner.frameElement.remove(); }
  };
}
