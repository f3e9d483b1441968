// The colour scale of a property: its limits are percentiles of the particles, steady over frames, or typed numbers.

const PERCENTILES = [0.02, 0.98];
const SMOOTHING = 0.03; // fraction of the distance to a frame's percentiles by which the limits move

/** Start of the colours, 0 to 1: their dark end is invisible on a dark background. */
export const colourStart = (dark) => (dark ? 0.18 : 0);

/** A colour of `table` for a share from 0 to 1, as CSS. */
export function colourAt(table, share, dark) {
  const from = colourStart(dark);
  const place = (from + (1 - from) * share) * (table.length - 1);
  const below = Math.min(Math.floor(place), table.length - 2);
  const mixed = table[below].map((part, i) => Math.round(part + (table[below + 1][i] - part) * (place - below)));
  return `rgb(${mixed.join(" ")})`;
}

/** A number with two significant digits. */
export function shortNumber(number) {
  if (number === 0) return "0";
  const size = Math.abs(number);
  return size >= 1e-3 && size < 1e4 ? String(Number(number.toPrecision(2))) : number.toExponential(1);
}

/** Levels (0 to 255) at the percentiles; null without particles. */
function percentiles(levels) {
  const counts = new Uint32Array(256);
  for (const level of levels) counts[level] += 1;
  const ends = [];
  let sum = 0;
  for (let level = 0; level < 256; level++) {
    sum += counts[level];
    while (ends.length < 2 && sum > PERCENTILES[ends.length] * (levels.length - 1)) ends.push(level);
  }
  return ends.length === 2 ? ends : null;
}

/** Limits of one property. Coordinates are what the colours are linear in: the number, or its logarithm. */
class Limits {
  typed = [null, null];
  automatic = null; // coordinates

  /** Follows the levels of a frame; `coordinate` is that of a level. */
  follow(levels, coordinate) {
    const target = percentiles(levels)?.map(coordinate);
    if (!target) return;
    this.automatic = this.automatic?.map((now, end) => now + SMOOTHING * (target[end] - now)) ?? target;
  }

  get isTyped() {
    return this.typed.some((limit) => limit != null);
  }
}

/** Speeds: levels are square roots of speed / top speed. */
export class SpeedScale extends Limits {
  unit = "domain lengths/s";

  update(frame) {
    const side = frame.truth.present ? frame.truth : frame.prediction;
    this.follow(new Uint8Array(frame.buffer, side.speed, frame.particles), (level) => (level / 255) ** 2 * frame.topSpeed);
  }

  /** Lower and upper limit. */
  get limits() {
    const [low, high] = this.automatic ?? [0, 1];
    return this.widened([this.typed[0] ?? low, this.typed[1] ?? high]);
  }

  widened([low, high]) {
    const least = 1e-3;
    return high - low >= least ? [low, high] : this.typed[1] == null ? [low, low + least] : [high - least, high];
  }

  /** Why a number cannot be a limit; empty if it can. */
  problemWith(number) {
    return number >= 0 ? "" : "expected 0 or more";
  }

  /** Offset and factor from the squared level (0 to 1) to a position on the colour scale (0 to 1). */
  mapping({ topSpeed }) {
    const [low, high] = this.limits;
    return [low / topSpeed, topSpeed / (high - low)];
  }
}

/** Errors: levels are logarithms between the two `ends`. */
export class ErrorScale extends Limits {
  unit = "domain lengths, logarithmic";
  ends = [1e-5, 1e-1];

  update(frame) {
    if (!frame.pair) return;
    this.follow(new Uint8Array(frame.buffer, frame.errors, frame.particles), (level) => this.logarithm(level / 255));
  }

  logarithm(share) {
    const [first, last] = this.ends.map(Math.log10);
    return first + (last - first) * share;
  }

  get limits() {
    const automatic = (this.automatic ?? this.ends.map(Math.log10)).map((power) => 10 ** power);
    const [low, high] = automatic.map((limit, end) => this.typed[end] ?? limit);
    return high > 1.1 * low ? [low, high] : this.typed[1] == null ? [low, 1.1 * low] : [high / 1.1, high];
  }

  problemWith(number) {
    return number > 0 ? "" : "expected a positive number";
  }

  /** Offset and factor from a level (0 to 1) to a position on the colour scale (0 to 1). */
  mapping() {
    const [first, last] = this.ends.map(Math.log10);
    const [low, high] = this.limits.map((limit) => (Math.log10(limit) - first) / (last - first));
    return [low, 1 / (high - low)];
  }
}
