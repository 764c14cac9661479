// WebSocket that is open while its page is visible, and opened again after a break.

const MAX_DELAY = 2000; // ms between two attempts to connect

export class PageSocket {
  // address(): path with its query; taken(data, socket): a message; changed(state): "live", "waiting", "hidden",
  // "ended", or the reason given to `close`.
  constructor({ address, taken, changed }) {
    Object.assign(this, { address, taken, changed, delay: 250, asleep: false });
    document.addEventListener("visibilitychange", () => (document.hidden ? this.close("hidden") : this.open()));
  }

  open() {
    clearTimeout(this.timer);
    if (this.socket || this.asleep || document.hidden) return;
    const address = new URL(this.address(), document.baseURI);
    address.protocol = address.protocol.replace("http", "ws");
    const socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onmessage = (event) => this.socket === socket && this.taken(event.data, socket);
    socket.onopen = () => {
      this.delay = 250;
      this.changed("live");
    };
    socket.onclose = () => {
      if (this.socket !== socket) return;
      this.socket = null;
      this.changed("waiting");
      this.timer = setTimeout(() => this.open(), this.delay);
      this.delay = Math.min(MAX_DELAY, 2 * this.delay);
      this.askWhy();
    };
  }

  // A browser does not say why a socket was refused. A session at this port takes back the pages of those before it;
  // if it was started by another user, or at a free port, it refuses them.
  async askWhy() {
    const answer = await fetch("api/status").catch(() => null);
    if (answer?.status === 403) this.close("ended");
  }

  close(why) {
    clearTimeout(this.timer);
    const { socket } = this;
    this.socket = null;
    socket?.close();
    this.changed(why);
  }

  // While asleep it stays closed: nothing is computed or sent.
  sleep(asleep) {
    this.asleep = asleep;
    if (asleep) this.close("hidden");
    else this.open();
  }

  send(text) {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(text);
  }
}
