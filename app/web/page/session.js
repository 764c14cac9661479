// What runs at this address, what is being started, and what could not be; asked again and again while it is looked at.

const REST = 700; // ms
const HASTE = 250; // while something is being started

export class Session extends EventTarget {
  constructor(boot) {
    super();
    this.boot = boot;
    this.state = null;
    this.woken = () => this.ask();
    document.addEventListener("visibilitychange", this.woken);
    this.ask();
  }

  close() {
    this.closed = true;
    clearTimeout(this.timer);
    document.removeEventListener("visibilitychange", this.woken);
  }

  async ask() {
    clearTimeout(this.timer);
    if (document.hidden || this.closed) return;
    const answer = await fetch("/api/session").catch(() => null);
    if (answer?.ok && !this.closed) this.take(await answer.json());
    clearTimeout(this.timer);
    if (!this.closed) this.timer = setTimeout(() => this.ask(), this.state?.starting ? HASTE : REST);
  }

  take(state) {
    // Something else runs than when this page was opened: whoever looks goes there.
    if (state.boot !== this.boot) leave();
    this.state = state;
    this.dispatchEvent(new CustomEvent("state", { detail: state }));
  }

  // The answer to a question that changes the state; why not, if it was refused.
  async tell(asked) {
    const answer = await asked;
    if (!answer.error) this.take(answer);
    else this.dispatchEvent(new CustomEvent("state", { detail: { ...this.state, failed: { title: "It", text: answer.error } } }));
    this.ask();
  }
}

// To what runs now; a link to a moment of it goes along.
function leave() {
  if (location.pathname === "/") location.reload();
  else location.replace(location.hash.includes("twin=") ? `/${location.hash}` : "/");
}

// How far what is being started has come.
export const progress = ({ doing, seconds }) => `${doing || "starting"} … ${Math.floor(seconds)} s`;

// Resolves to the answer, or {error} with the reason.
export async function post(path, body, method = "POST") {
  try {
    const answer = await fetch(path, { method, headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
    const text = await answer.text();
    return answer.headers.get("content-type")?.includes("json") ? JSON.parse(text) : { error: text.trim() };
  } catch {
    return { error: "Nisus does not answer" };
  }
}
