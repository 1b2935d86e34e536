"use strict";
// The hand: its arrays, its bones, and what a pose makes of them. No pictures here.
// Matrices of rotations are nine numbers, row by row; lengths are metres, angles radians.

const IDENTITY = [1, 0, 0, 0, 1, 0, 0, 0, 1];
const PARENTS = [-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14];
const BONES = PARENTS.length;

const product = (a, b) => {
  const c = new Array(9);
  for (let i = 0; i < 3; i += 1) {
    for (let j = 0; j < 3; j += 1) c[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
  }
  return c;
};
const transposed = (a) => [a[0], a[3], a[6], a[1], a[4], a[7], a[2], a[5], a[8]];
const applied = (a, v) => [0, 3, 6].map((row) => a[row] * v[0] + a[row + 1] * v[1] + a[row + 2] * v[2]);
const plus = (a, b) => a.map((value, at) => value + b[at]);
const minus = (a, b) => a.map((value, at) => value - b[at]);
const length = (v) => Math.hypot(...v);

function turnOf(vector) { // of an axis-angle vector (Rodrigues)
  const angle = length(vector);
  if (angle < 1e-9) return IDENTITY;
  const [x, y, z] = vector.map((value) => value / angle);
  const [s, c] = [Math.sin(angle), Math.cos(angle)];
  const d = 1 - c;
  return [c + x * x * d, x * y * d - z * s, x * z * d + y * s, y * x * d + z * s, c + y * y * d, y * z * d - x * s,
    z * x * d - y * s, z * y * d + x * s, c + z * z * d];
}

function ofQuaternion({ x, y, z, w }) {
  return [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), 2 * (x * y + z * w), 1 - 2 * (x * x + z * z),
    2 * (y * z - x * w), 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)];
}

function opened(about, text) { // the arrays by name, from base64
  const letters = atob(text.trim());
  const bytes = new Uint8Array(letters.length);
  for (let at = 0; at < bytes.length; at += 1) bytes[at] = letters.charCodeAt(at);
  const kinds = { f4: Float32Array, i2: Int16Array, u2: Uint16Array, u4: Uint32Array, i1: Int8Array, u1: Uint8Array };
  const arrays = {};
  for (const { name, kind, start, count, scale } of about.arrays) {
    const stored = new kinds[kind](bytes.buffer, start, count);
    arrays[name] = scale === undefined ? stored : Float32Array.from(stored, (value) => value * scale);
  }
  return arrays;
}

// One round of midpoint subdivision: new vertices in the order of their edges (lower end first).
function subdivided(faces, count) {
  const keys = new Float64Array(faces.length);
  const key = (a, b) => Math.min(a, b) * count + Math.max(a, b);
  for (let at = 0; at < faces.length; at += 3) {
    for (let side = 0; side < 3; side += 1) keys[at + side] = key(faces[at + side], faces[at + (side + 1) % 3]);
  }
  const edges = Float64Array.from(new Set(keys)).sort();
  const numbers = new Map(Array.from(edges, (edge, at) => [edge, count + at]));
  const ends = new Uint32Array(2 * edges.length);
  edges.forEach((edge, at) => { ends[2 * at] = Math.floor(edge / count); ends[2 * at + 1] = edge % count; });
  const finer = new Uint32Array(4 * faces.length);
  for (let at = 0; at < faces.length; at += 3) {
    const [a, b, c] = faces.subarray(at, at + 3);
    const [ab, bc, ca] = [numbers.get(key(a, b)), numbers.get(key(b, c)), numbers.get(key(c, a))];
    finer.set([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], 4 * at);
  }
  return { ends, faces: finer };
}

class Hand {
  constructor(about, arrays) {
    this.about = about;
    Object.assign(this, arrays);
    this.coarse = this.vertices.length / 3;
    this.levels = [];
    let [faces, count] = [Uint32Array.from(this.faces), this.coarse];
    for (let round = 0; round < about.rounds; round += 1) {
      const level = subdivided(faces, count);
      this.levels.push(level);
      faces = level.faces;
      count += level.ends.length / 2;
    }
    // One vertex more closes the wrist: the mean of its rim.
    this.count = count + 1;
    const fan = [];
    this.rim.forEach((vertex, at) => fan.push(this.rim[(at + 1) % this.rim.length], vertex, count));
    this.fine = new Uint32Array(faces.length + fan.length);
    this.fine.set(faces);
    this.fine.set(fan, faces.length);
    this.rest = new Float32Array(3 * this.count);
    this.shapesOf = this.shapes.length / this.vertices.length;
  }

  // Values of the coarse vertices on all others.
  carry(values, width) {
    let at = width * this.coarse;
    for (const { ends } of this.levels) {
      for (let edge = 0; edge < ends.length; edge += 2) {
        const [a, b] = [width * ends[edge], width * ends[edge + 1]];
        for (let column = 0; column < width; column += 1, at += 1) values[at] = (values[a + column] + values[b + column]) / 2;
      }
    }
    for (let column = 0; column < width; column += 1) {
      let sum = 0;
      for (const vertex of this.rim) sum += values[width * vertex + column];
      values[at + column] = sum / this.rim.length;
    }
    return values;
  }

  // Everything that all vertices share in a pose: { rotations: relative to the parent, wrist }.
  posed(rotations, wrist) {
    const features = [];
    for (const turn of rotations.slice(1)) turn.forEach((value, at) => features.push(value - IDENTITY[at]));
    const amounts = this.driven(features);
    const joints = Float32Array.from(this.joints);
    const rest = this.rest;
    rest.set(this.vertices);
    amounts.forEach((amount, shape) => {
      const [here, there] = [shape * this.vertices.length, shape * joints.length];
      for (let at = 0; at < this.vertices.length; at += 1) rest[at] += amount * this.shapes[here + at];
      for (let at = 0; at < joints.length; at += 1) joints[at] += amount * this.joint_shapes[there + at];
    });
    this.carry(rest, 3);
    const [turns, places] = [[], []];
    for (let bone = 0; bone < BONES; bone += 1) {
      const joint = joints.subarray(3 * bone, 3 * bone + 3);
      const parent = PARENTS[bone];
      if (parent < 0) {
        turns.push(rotations[0]);
        places.push(wrist || Array.from(joint));
      } else {
        const arm = minus(Array.from(joint), joints.subarray(3 * parent, 3 * parent + 3));
        turns.push(product(turns[parent], rotations[bone]));
        places.push(plus(places[parent], applied(turns[parent], arm)));
      }
    }
    const motions = new Float32Array(16 * BONES); // column by column, as WebGL has them
    turns.forEach((turn, bone) => {
      const shift = minus(places[bone], applied(turn, joints.subarray(3 * bone, 3 * bone + 3)));
      for (let row = 0; row < 3; row += 1) {
        for (let column = 0; column < 3; column += 1) motions[16 * bone + 4 * column + row] = turn[3 * row + column];
        motions[16 * bone + 12 + row] = shift[row];
      }
      motions[16 * bone + 15] = 1;
    });
    const capsules = new Float32Array(8 * this.capsule_bones.length);
    this.capsule_bones.forEach((bone, at) => {
      for (let end = 0; end < 2; end += 1) {
        const from = 6 * at + 3 * end;
        const place = plus(places[bone], applied(turns[bone], this.capsule_ends.subarray(from, from + 3)));
        capsules.set([...place, this.capsule_radii[2 * at + end]], 8 * at + 4 * end);
      }
    });
    const [a, b, , d, e, , g, h] = rotations[0];
    return { rest, motions, capsules, biases: this.biases([a, b, d, e, g, h, ...features]), places };
  }

  driven(features) {
    const width = features.length + 1;
    return Array.from({ length: this.shapesOf }, (_, shape) => {
      let sum = this.shape_weights[shape * width + features.length];
      features.forEach((value, at) => { sum += value * this.shape_weights[shape * width + at]; });
      return sum;
    });
  }

  biases(features) {
    const layer = (weights, biases, inputs) => Float32Array.from(biases, (bias, row) => (
      inputs.reduce((sum, value, at) => sum + value * weights[row * inputs.length + at], bias)));
    const hidden = layer(this.pose_hidden_weight, this.pose_hidden_bias, features).map(Math.tanh);
    return layer(this.pose_output_weight, this.pose_output_bias, hidden);
  }

  // Rotations of flexion, abduction and twist, degrees.
  bent(angles) {
    return angles.map((row, bone) => row.reduce((turn, angle, at) => {
      const axis = this.axes.subarray(9 * bone + 3 * at, 9 * bone + 3 * at + 3);
      return product(turn, turnOf(Array.from(axis, (value) => value * angle * Math.PI / 180)));
    }, IDENTITY));
  }

  // Inverse of `bent`, for sliders.
  angles(rotations) {
    return rotations.map((turn, bone) => {
      const axes = Array.from(this.axes.subarray(9 * bone, 9 * bone + 9));
      const m = product(product(axes, turn), transposed(axes));
      return [Math.atan2(-m[5], m[8]), Math.atan2(m[2], Math.hypot(m[0], m[1])), Math.atan2(-m[1], m[0])]
        .map((angle) => angle * 180 / Math.PI);
    });
  }

  // Bones of a tracked hand: rotations relative to the parent, in the light's axes, and the wrist.
  // `joints` holds { turn, place } by name of WebXR; `world` turns the headset's axes to the light's.
  tracked(joints, world) {
    const { names, rest, turn } = this.about.xr;
    const turns = names.map((name, bone) => (
      product(world, product(product(joints[name].turn, transposed(rest[bone])), turn))));
    const rotations = turns.map((here, bone) => (
      PARENTS[bone] < 0 ? here : product(transposed(turns[PARENTS[bone]]), here)));
    return { rotations, wrist: applied(world, joints[names[0]].place), size: this.size(joints) };
  }

  // Their bones' length in those of the avatar.
  size(joints) {
    let [theirs, own] = [0, 0];
    this.about.xr.names.forEach((name, bone) => {
      const parent = PARENTS[bone];
      if (parent < 1) return;
      theirs += length(minus(joints[name].place, joints[this.about.xr.names[parent]].place));
      own += length(minus(Array.from(this.joints.subarray(3 * bone, 3 * bone + 3)),
        this.joints.subarray(3 * parent, 3 * parent + 3)));
    });
    return theirs / own;
  }
}
