// The last frames that were drawn, for the timeline.

import { timeOf } from "/frame.js";

const SECONDS = 20; // simulation time
const BYTES = 64 << 20;
const JUMP = 1; // s; a larger step of time is a restart or a pause, and takes none of the SECONDS

export class History {
  constructor() {
    this.clear();
  }

  clear() {
    this.entries = []; // frame, and its time without jumps (s)
    this.bytes = 0;
    this.stride = 1; // one of this many frames is kept
    this.skipped = 0;
    this.last = null; // time of the last frame (s), and the same without jumps
  }

  get length() {
    return this.entries.length;
  }

  frame(index) {
    return this.entries[index].frame;
  }

  /** Simulation time covered (s). */
  get span() {
    return this.length ? this.entries.at(-1).at - this.entries[0].at : 0;
  }

  /** Adds a frame. Frames that are too large for all to be kept are thinned out, so that the time covered stays the same. */
  add(frame) {
    const time = timeOf(frame);
    const step = this.last ? time - this.last.time : 0;
    const at = (this.last?.at ?? 0) + (step > 0 && step <= JUMP ? step : 0);
    this.last = { time, at };
    this.skipped += 1;
    if (this.skipped < this.stride) return;
    this.skipped = 0;
    this.entries.push({ frame, at });
    this.bytes += frame.buffer.byteLength;
    while (at - this.entries[0].at > SECONDS) this.bytes -= this.entries.shift().frame.buffer.byteLength;
    if (this.stride > 1 && this.bytes < BYTES / 4) this.stride /= 2;
    if (this.bytes > BYTES && this.length > 2) {
      this.stride *= 2;
      this.entries = this.entries.filter((_, index) => (this.length - 1 - index) % 2 === 0);
      this.bytes = this.entries.reduce((sum, entry) => sum + entry.frame.buffer.byteLength, 0);
    }
  }
}
