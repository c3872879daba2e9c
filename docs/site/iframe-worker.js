// Browsers start no Worker on a page that is opened from disk. The theme's search runs in one, so on such pages this class
// takes its place: it runs the same script in a hidden frame. The theme's `offline` plugin would fetch such a script from
// another host; it leaves that out where `polyfills` names a script with "iframe-worker" in its name.
if (location.protocol === "file:") window.Worker = class extends EventTarget {
  constructor(url) {
    super();
    this.frame = document.createElement("iframe");
    this.frame.hidden = true;
    document.body.append(this.frame);
    const inside = this.frame.contentWindow;
    // every importScripts waits for the one before it
    const prepare = `
      window.postMessage = data => parent.postMessage(data, "*");
      window.importScripts = (...urls) => urls.reduce((before, url) => before.then(() => new Promise((done, failed) => {
        const script = document.createElement("script");
        script.src = url; script.onload = done; script.onerror = failed;
        document.body.append(script);
      })), Promise.resolve());`;
    inside.document.open();
    inside.document.write(`<body><script>${prepare}<\/script><script src="${url}"><\/script></body>`);
    inside.document.close();
    this.ready = new Promise(done => inside.addEventListener("load", done));
    addEventListener("message", event => {
      if (event.source === inside) this.dispatchEvent(new MessageEvent("message", { data: event.data }));
    });
  }
  postMessage(data) {
    this.ready.then(() => this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data })));
  }
};
