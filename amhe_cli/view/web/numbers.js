// Arrays from text, and the little mathematics of a scene: columns of 4 x 4 matrices, quaternions w x y z.
function bytes(text) {
  const raw = atob(text), out = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
  return out.buffer;
}
const floats = (text) => new Float32Array(bytes(text));
const rows = (text) => new Uint16Array(bytes(text));

// 16-bit numbers between the ends of their column; NaN where there is none.
function unpacked(text, [low, high]) {
  const whole = new Int16Array(bytes(text)), width = low.length, out = new Float32Array(whole.length);
  for (let i = 0; i < whole.length; i++) {
    const k = i % width;
    out[i] = whole[i] === -32768 ? NaN : low[k] + (whole[i] / 32767 + 1) / 2 * (high[k] - low[k]);
  }
  return out;
}

const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const less = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const times = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => times(a, 1 / (Math.hypot(...a) || 1));

// The matrix of a pose: position and quaternion, from place `at` of an array.
function placed(pose, at = 0) {
  const [x, y, z, w, i, j, k] = pose.slice(at, at + 7);
  return [
    1 - 2 * (j * j + k * k), 2 * (i * j + k * w), 2 * (i * k - j * w), 0,
    2 * (i * j - k * w), 1 - 2 * (i * i + k * k), 2 * (j * k + i * w), 0,
    2 * (i * k + j * w), 2 * (j * k - i * w), 1 - 2 * (i * i + j * j), 0, x, y, z, 1,
  ];
}
function product(a, b) {
  const out = new Array(16);
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) {
    out[4 * c + r] = a[r] * b[4 * c] + a[4 + r] * b[4 * c + 1] + a[8 + r] * b[4 * c + 2] + a[12 + r] * b[4 * c + 3];
  }
  return out;
}
function looking(eye, at, up) {
  const back = unit(less(eye, at)), right = unit(cross(up, back)), top = cross(back, right);
  return [right[0], top[0], back[0], 0, right[1], top[1], back[1], 0, right[2], top[2], back[2], 0,
    -dot(right, eye), -dot(top, eye), -dot(back, eye), 1];
}
function perspective(half, aspect, near, far) {
  const f = 1 / half;
  return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, 2 * far * near / (near - far), 0];
}
// Flattens everything along the light onto the plane z = height.
function shadowed(light, height) {
  const a = light[0] / light[2], b = light[1] / light[2];
  return [1, 0, 0, 0, 0, 1, 0, 0, -a, -b, 0, 0, a * height, b * height, height, 1];
}

// Frames at equal steps: bodies' poses and plotted values; grows in a live page.
class Track {
  constructor(step, bodies, width, poses, values) {
    Object.assign(this, { step, bodies, width, poses, values, count: poses.length / (7 * bodies || 1) });
  }
  // Appends a frame with a number; frames that did not come are the one before.
  push(poses, frame) {
    const wide = 7 * this.bodies;
    if ((frame + 1) * wide > this.poses.length) { const more = new Float32Array(2 * (frame + 1) * wide); more.set(this.poses); this.poses = more; }
    const before = this.poses.slice((this.count - 1) * wide, this.count * wide);
    for (; this.count < frame; this.count++) this.poses.set(before.length ? before : poses, this.count * wide);
    if (this.count === frame) this.poses.set(poses, this.count++ * wide);
  }
  get duration() { return this.step * Math.max(this.count - 1, 0); }
  // Poses of all bodies at a time from the track's start, between frames interpolated.
  at(time) {
    const wide = 7 * this.bodies, place = Math.min(Math.max(time / this.step, 0), this.count - 1);
    const frame = Math.min(Math.floor(place), Math.max(this.count - 2, 0)), share = place - frame;
    const a = this.poses.subarray(frame * wide, (frame + 1) * wide);
    if (share < 1e-6 || this.count < 2) return a;
    const b = this.poses.subarray((frame + 1) * wide, (frame + 2) * wide), out = new Float32Array(wide);
    for (let i = 0; i < wide; i += 7) {
      let near = 0, norm = 0;
      for (let k = 3; k < 7; k++) near += a[i + k] * b[i + k];
      for (let k = 0; k < 7; k++) {
        out[i + k] = (1 - share) * a[i + k] + share * (k > 2 && near < 0 ? -b[i + k] : b[i + k]);
        if (k > 2) norm += out[i + k] ** 2;
      }
      for (let k = 3; k < 7; k++) out[i + k] /= Math.sqrt(norm) || 1;
    }
    return out;
  }
  value(time, column) {
    const frame = Math.round(time / this.step);
    return frame >= 0 && frame < this.count ? this.values[frame * this.width + column] : NaN;
  }
}
