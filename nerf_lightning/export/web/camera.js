// A camera: position and axes right, down and ahead in the world frame, as in cameras/transforms.py.

const add = (a, b, by = 1) => [a[0] + by * b[0], a[1] + by * b[1], a[2] + by * b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scaled = (a, by) => [a[0] * by, a[1] * by, a[2] * by];
const unitLength = a => scaled(a, 1 / (Math.hypot(...a) || 1));
const between = (a, b, share) => a.map((x, i) => x + share * (b[i] - x));
const turned = (a, axis, angle) =>          // Rodrigues' rotation
  add(add(scaled(a, Math.cos(angle)), cross(axis, a), Math.sin(angle)), axis, dot(axis, a) * (1 - Math.cos(angle)));

const STEEPEST = 0.995;                     // maximum cosine between ahead and up when turning
class Camera {
  // lens: width, height, fx, fy, cx, cy in pixels of the original image; target: center of rotation.
  constructor(right, down, ahead, eye, lens, target) { Object.assign(this, { right, down, ahead, eye, lens, target }); }

  // From a 3 x 4 camera-to-world matrix; the target is the point on the optical axis nearest to the focus.
  static from(rows, lens, focus) {
    const column = i => [rows[i], rows[4 + i], rows[8 + i]], ahead = column(2), eye = column(3);
    const far = dot(add(focus, eye, -1), ahead), away = Math.hypot(...add(focus, eye, -1));
    return new Camera(column(0), column(1), ahead, eye, lens, add(eye, ahead, far > 0.1 * away ? far : away));
  }
  copy() { return Object.assign(Object.create(Camera.prototype), this); }
  get distance() { return Math.hypot(...add(this.eye, this.target, -1)); }

  // Intrinsics on a canvas that shows the whole image.
  lensOn(width, height) {
    const [w, h, fx, fy, cx, cy] = this.lens, by = Math.min(width / w, height / h);
    return [fx * by, fy * by, (cx - w / 2) * by + width / 2, (cy - h / 2) * by + height / 2];
  }

  // across, down and ahead of march.glsl.
  axes(width, height) {
    const [fx, fy, cx, cy] = this.lensOn(width, height), across = scaled(this.right, 1 / fx), down = scaled(this.down, 1 / fy);
    return [across, down, add(add(this.ahead, across, -cx), down, -cy)];
  }

  // Canvas position of a point, or null behind the camera.
  project(place, width, height) {
    const [fx, fy, cx, cy] = this.lensOn(width, height), away = add(place, this.eye, -1), depth = dot(away, this.ahead);
    return depth > 1e-6 ? [cx + fx * dot(away, this.right) / depth, cy + fy * dot(away, this.down) / depth] : null;
  }
  turn(yaw, pitch, up) {
    for (const [axis, angle] of [[up, yaw], [this.right, pitch]]) {
      const steep = dot(turned(this.ahead, axis, angle), up);
      if (axis !== up && Math.abs(steep) > STEEPEST && Math.abs(steep) > Math.abs(dot(this.ahead, up))) continue;
      for (const name of ["right", "down", "ahead"]) this[name] = unitLength(turned(this[name], axis, angle));
      this.eye = add(this.target, turned(add(this.eye, this.target, -1), axis, angle));
    }
  }
  approach(factor) { this.eye = add(this.target, add(this.eye, this.target, -1), factor); }

  // Pans by canvas pixels: points at the target's distance follow the pointer.
  slide(x, y, width, height) {
    const [fx, fy] = this.lensOn(width, height), depth = this.distance;
    const move = add(scaled(this.right, -x * depth / fx), this.down, -y * depth / fy);
    this.eye = add(this.eye, move);
    this.target = add(this.target, move);
  }
  toward(other, share) {
    const ahead = unitLength(between(this.ahead, other.ahead, share)), right = between(this.right, other.right, share);
    const upright = unitLength(add(right, ahead, -dot(right, ahead)));
    const [eye, lens, target] = ["eye", "lens", "target"].map(name => between(this[name], other[name], share));
    return new Camera(upright, cross(ahead, upright), ahead, eye, lens, target);
  }
}
