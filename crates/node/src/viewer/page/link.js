// The connection to the program: comes back by itself when it was lost.

const SHORTEST = 400; // ms before the first new try
const LONGEST = 4000;

export class Link {
  /** `on` has the functions opened, closed(ms until the next try), words(object), frame(ArrayBuffer). */
  constructor(on) {
    this.on = on;
    this.wait = SHORTEST;
    this.connect();
    addEventListener("online", () => this.now());
    addEventListener("visibilitychange", () => document.hidden || this.now());
  }

  connect() {
    clearTimeout(this.timer);
    this.timer = 0;
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/ws`);
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.wait = SHORTEST;
      this.on.opened();
    };
    socket.onmessage = ({ data }) => {
      if (typeof data === "string") this.on.words(JSON.parse(data));
      else this.on.frame(data);
    };
    socket.onclose = () => {
      if (socket !== this.socket) return;
      this.on.closed(this.wait);
      this.timer = setTimeout(() => this.connect(), this.wait);
      this.wait = Math.min(this.wait * 1.6, LONGEST);
    };
  }

  /** Tries at once what would be tried later. */
  now() {
    if (this.timer) this.connect();
  }

  /** Whether it is said: without a connection it is not. */
  say(words) {
    if (this.socket.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(words));
    return true;
  }
}
