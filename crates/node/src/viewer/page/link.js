// The connection to the program; reconnects when it is lost.

const MIN_DELAY = 400; // ms before the first retry
const MAX_DELAY = 4000;

export class Link {
  /** `on` has the callbacks opened, closed(ms until the next retry), message(object), frame(ArrayBuffer). */
  constructor(on) {
    this.on = on;
    this.delay = MIN_DELAY;
    this.connect();
    addEventListener("online", () => this.retry());
    addEventListener("visibilitychange", () => document.hidden || this.retry());
  }

  connect() {
    clearTimeout(this.timer);
    this.timer = 0;
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/ws`);
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.delay = MIN_DELAY;
      this.on.opened();
    };
    socket.onmessage = ({ data }) => {
      if (typeof data === "string") this.on.message(JSON.parse(data));
      else this.on.frame(data);
    };
    socket.onclose = () => {
      if (socket !== this.socket) return;
      this.on.closed(this.delay);
      this.timer = setTimeout(() => this.connect(), this.delay);
      this.delay = Math.min(this.delay * 1.6, MAX_DELAY);
    };
  }

  /** Retries at once if a retry is pending. */
  retry() {
    if (this.timer) this.connect();
  }

  /** Sends an object. Returns whether there is a connection. */
  send(message) {
    if (this.socket.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }
}
