// Search from a page on disk: browsers start no worker from a file, so its script runs in a frame of its own instead.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      this.queue = [];
      window.addEventListener("message", (event) => {
        if (event.source === frame.contentWindow) {
          this.dispatchEvent(new MessageEvent("message", { data: event.data }));
        }
      });
      frame.addEventListener("load", () => {
        this.frame = frame.contentWindow;
        this.queue.splice(0).forEach((data) => this.postMessage(data));
      });
      frame.srcdoc = `<script>
        window.postMessage = (data) => parent.postMessage(data, "*");
        window.importScripts = (...urls) => Promise.all(urls.map((url) => new Promise((done) => {
          document.head.append(Object.assign(document.createElement("script"), { src: url, onload: done }));
        })));
      <\/script><script src="${new URL(url, document.baseURI)}"><\/script>`;
      document.body.append(frame);
    }
    postMessage(data) {
      if (this.frame) this.frame.dispatchEvent(new MessageEvent("message", { data }));
      else this.queue.push(data);
    }
  };
}
