// One time for the windows of one twin: the page tells which moment it shows, and Rerun in a window of its own tells the
// page where it was scrubbed to. Windows of one browser hear each other; nothing goes over the network.

const name = (boot) => `nisus time ${boot}`;

// On the page.
export class SharedTime {
  constructor(boot, view, charts) {
    Object.assign(this, { view, charts });
    this.channel = new BroadcastChannel(name(boot));
    this.channel.onmessage = ({ data }) => {
      if (data.asks) this.say();
      if (data.follow) view.follow();
      if (Number.isFinite(data.goTo)) view.goTo(data.goTo, charts.range, charts.newest);
    };
    view.addEventListener("change", () => this.say());
    window.addEventListener("pagehide", () => this.channel.postMessage({ gone: true }));
    this.say();
  }

  say() {
    this.channel.postMessage({ at: this.view.following ? null : this.view.at });
  }
}

// In a window of its own, in place of the page's view: `paired` while there is a page.
export class RemoteView extends EventTarget {
  constructor(boot) {
    super();
    this.at = null;
    this.paired = false;
    this.channel = new BroadcastChannel(name(boot));
    this.channel.onmessage = ({ data }) => {
      if (data.asks || data.follow || "goTo" in data) return; // another window like this
      this.paired = !data.gone;
      if (!data.gone) this.at = data.at;
      this.changed();
    };
    this.channel.postMessage({ asks: true });
  }

  get following() {
    return this.at === null;
  }

  goTo(time) {
    this.at = time;
    this.channel.postMessage({ goTo: time });
    this.changed();
  }

  follow() {
    this.at = null;
    this.channel.postMessage({ follow: true });
    this.changed();
  }

  changed() {
    this.dispatchEvent(new Event("change"));
  }
}
