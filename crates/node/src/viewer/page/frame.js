// A displayed frame as bytes; the layout is described in `viewer::wire`.

const VERSION = 3;
const HEADER = 96;

/** Decodes an ArrayBuffer; null if it is not a frame. Offsets are in bytes, for WebGL. */
export function read(buffer) {
  const view = new DataView(buffer);
  if (buffer.byteLength < HEADER || view.getUint8(0) !== 0x45 || view.getUint8(1) !== 0x44
    || view.getUint8(2) !== 0x59 || view.getUint8(3) !== VERSION) return null;
  const flags = view.getUint32(4, true);
  const particles = view.getUint32(8, true);
  const [tools, forces] = [84, 88].map((at) => 3 * view.getUint32(at, true));
  if (buffer.byteLength < HEADER + 12 * particles + 8 * (tools + forces)) return null;
  const f32 = (at) => view.getFloat32(at, true);
  const side = (number) => ({
    present: (flags & (1 << number)) !== 0,
    sequence: view.getBigUint64(24 + 8 * number, true),
    stamp: view.getFloat64(40 + 8 * number, true),
    position: HEADER + 4 * particles * number,
    speed: HEADER + 8 * particles + particles * number,
  });
  return {
    buffer,
    particles,
    pair: (flags & 4) !== 0,
    freeRunning: (flags & 8) !== 0,
    horizon: view.getUint32(12, true),
    stream: view.getBigUint64(16, true).toString(),
    lower: [f32(56), f32(60)],
    upper: [f32(64), f32(68)],
    topSpeed: f32(72),
    error: f32(76),
    baseline: f32(80),
    truth: side(0),
    prediction: side(1),
    errors: HEADER + 10 * particles,
    materials: HEADER + 11 * particles,
    // Offset of their corners, and how many there are.
    shapes: { at: HEADER + 12 * particles, tools, forces },
  };
}

/** Width over height of the domain. */
export const aspectOf = ({ lower, upper }) => (upper[0] - lower[0]) / (upper[1] - lower[1]);
/** Simulation time (s): of the truth, or of the prediction if it is alone. */
export const timeOf = ({ truth, prediction }) => (truth.present ? truth : prediction).stamp;
/** The middle of the tools that are drawn (domain lengths); null if there are none. */
export function toolOf({ buffer, shapes, lower, upper }) {
  if (!shapes.tools) return null;
  const corners = new Float32Array(buffer, shapes.at, 2 * shapes.tools);
  const middle = (axis) => corners.reduce((sum, part, index) => sum + (index % 2 === axis ? part : 0), 0) / shapes.tools;
  return [0, 1].map((axis) => lower[axis] + middle(axis) * (upper[axis] - lower[axis]));
}
