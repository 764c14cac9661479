// The stream of frames for Rerun, for as long as somebody can see them.

const SLOWEST = 8000; // ms between two attempts to connect
const SHARE = 0.5; // part of the time that drawing may take; the panel beside it needs the rest
const SLOW = 1000; // ms from which on a picture is dear, as where no graphics card draws it
const SLOW_SHARE = 0.2; // then the twin itself may need the processor
const LONGEST_REST = 8000; // ms

export class ExploreStream {
  // told(message): JSON messages; changed(state): "live", "waiting", "hidden", "ended", "failed"
  constructor({ viewer, told, changed }) {
    this.viewer = viewer;
    this.told = told;
    this.changed = changed;
    this.layout = true;
    this.delay = 250;
    this.asleep = false;
    document.addEventListener("visibilitychange", () => (document.hidden ? this.close("hidden") : this.open()));
    if (!document.hidden) this.open();
  }

  wake() {
    this.asleep = false;
    this.open();
  }

  // Nobody sees it: nothing is computed, sent or drawn.
  sleep() {
    this.asleep = true;
    this.close("hidden");
  }

  open() {
    clearTimeout(this.timer);
    if (this.socket || this.asleep || document.hidden) return;
    const socket = new WebSocket(`ws://${location.host}/rerun/stream?layout=${this.layout ? 1 : 0}&theme=${document.documentElement.dataset.theme}`);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    // One message after the other: each is drawn before the next is looked at.
    let line = Promise.resolve();
    socket.onmessage = (event) => {
      line = line.then(() => this.take(socket, event.data)).catch((error) => this.fail(error));
    };
    socket.onopen = () => {
      this.delay = 250;
      this.changed("live");
    };
    socket.onclose = () => {
      if (this.socket !== socket) return;
      this.socket = null;
      this.changed("waiting");
      this.timer = setTimeout(() => this.open(), this.delay);
      this.delay = Math.min(SLOWEST, 2 * this.delay);
      this.askWhy();
    };
  }

  // A browser does not say why a socket was refused. Each session has a token of its own: another one refuses ours.
  async askWhy() {
    const answer = await fetch("/api/status").catch(() => null);
    if (answer?.status === 403) this.close("ended");
  }

  close(why) {
    clearTimeout(this.timer);
    const socket = this.socket;
    this.socket = null;
    if (socket) socket.close();
    this.changed(why);
  }

  async take(socket, data) {
    if (this.socket !== socket) return;
    if (typeof data === "string") {
      const message = JSON.parse(data);
      if (message.recording) this.viewer.announce(message.recording);
      // What the user just asked for is worth a picture at once.
      const revision = message.status?.revision ?? this.revision;
      if (revision !== this.revision && this.resting) this.ask(socket);
      this.revision = revision;
      this.told(message);
      return;
    }
    const took = await this.viewer.feed(new Uint8Array(data));
    this.layout = false;
    this.told({ drawn: true });
    const share = took < SLOW ? SHARE : SLOW_SHARE;
    this.resting = setTimeout(() => this.ask(socket), Math.min(LONGEST_REST, took * (1 / share - 1)));
  }

  // Ask for the next frame.
  ask(socket) {
    clearTimeout(this.resting);
    this.resting = null;
    if (socket.readyState === WebSocket.OPEN) socket.send("drawn");
  }

  fail(error) {
    const reason = this.viewer.broken;
    console.error(reason ?? error);
    this.close("failed");
    this.told({ failed: String(reason ?? error) });
  }
}
