"use strict";
// Pictures of a hand by WebGL2. Skinning and light are computed once per pose for all vertices and
// kept in a buffer (transform feedback); a picture from any camera, or for each eye, only reads it.

const LAYERS = ["rgb", "albedo", "illumination", "normal"];

// Written out without loops: arrays that a loop's counter indexes are slow in many a shader.
const each = (count, write) => Array.from({ length: count }, (_, at) => write(at)).join("\n  ");

const capsuleLines = (bones, reach) => each(bones.length, (at) => `{
    vec4 start = capsules[${2 * at}], end = capsules[${2 * at + 1}];
    vec3 axis = end.xyz - start.xyz, offset = place - start.xyz;
    float share = clamp(dot(offset, axis) / dot(axis, axis), 0.0, 1.0);
    vec3 towards = share * axis - offset;
    float distance = max(length(towards), 1e-5), radius = mix(start.w, end.w, share), ratio = radius / distance;
    near${bones[at]} = max(near${bones[at]}, isShown[${bones[at]}] * exp(-max(distance - radius, 0.0) / ${reach}));
    filled${bones[at]} = max(filled${bones[at]},
      isShown[${bones[at]}] * min(ratio * ratio, 1.0) * max(dot(towards, facing) / distance, 0.0));
  }`);

const fourOf = (name, at) => `vec4(${[0, 1, 2, 3].map((next) => name + (4 * at + next)).join(", ")})`;
const sumOf = (count, term) => Array.from({ length: count }, (_, at) => term(at)).join(" + ");

const poseShader = (bones, reach) => `#version 300 es
precision highp float;
layout(std140) uniform Network {
  mat4 first[88];
  mat4 second[64];
  vec4 secondBias[8];
  vec4 last[8];
  vec4 lastBias;
};
uniform mat4 motions[${BONES}];
uniform vec4 capsules[${2 * bones.length}];
uniform float isShown[${BONES}];
uniform vec4 biases[8];
in vec3 rest;
in vec3 normal;
in uvec4 bones;
in vec4 shares;
in vec4 latents0;
in vec4 latents1;
out vec3 place;
out vec3 facing;
out float light;

void main() {
  mat4 motion = shares.x * motions[bones.x] + shares.y * motions[bones.y] + shares.z * motions[bones.z]
    + shares.w * motions[bones.w];
  place = (motion * vec4(rest, 1.0)).xyz;
  facing = normalize(mat3(motion) * normal);
  ${each(BONES, (bone) => `float near${bone} = 0.0, filled${bone} = 0.0;`)}
  ${capsuleLines(bones, reach)}
  vec4 input0 = latents0, input1 = latents1, input2 = vec4(facing, 0.0);
  ${each(4, (at) => `vec4 input${3 + at} = ${fourOf("near", at)}, input${7 + at} = ${fourOf("filled", at)};`)}
  ${each(8, (row) => `vec4 hidden${row} = max(biases[${row}] + ${sumOf(11, (at) => `first[${8 * at + row}] * input${at}`)}, 0.0);`)}
  float sum = lastBias.x;
  ${each(8, (row) => `sum += dot(last[${row}], max(secondBias[${row}] + ${sumOf(8, (at) => `second[${8 * at + row}] * hidden${at}`)}, 0.0));`)}
  light = 1.0 / (1.0 + exp(-sum));
  gl_Position = vec4(0.0);
}`;

const NOTHING = `#version 300 es
precision mediump float;
out vec4 color;
void main() { color = vec4(0.0); }`;

const VIEW = `#version 300 es
precision highp float;
uniform mat4 clip;
in vec3 place;
in vec3 facing;
in float light;
in vec3 albedo;
in vec4 paint;
out vec3 seenFacing;
out float seenLight;
out vec3 seenAlbedo;
out vec4 seenPaint;
void main() {
  seenFacing = facing;
  seenLight = light;
  seenAlbedo = albedo;
  seenPaint = paint;
  gl_Position = clip * vec4(place, 1.0);
}`;

const COLOR = `#version 300 es
precision highp float;
uniform int layer;
uniform float gain;
uniform vec3 shift;
in vec3 seenFacing;
in float seenLight;
in vec3 seenAlbedo;
in vec4 seenPaint;
out vec4 color;
void main() {
  // Colours are stored as pictures store them (sRGB), and multiplied so, as the avatar does.
  vec3 albedo = clamp(seenAlbedo + shift, 0.0, 1.0) * (1.0 - seenPaint.a) + seenPaint.rgb;
  float light = seenLight * gain;
  vec3 shown = layer == 0 ? albedo * light : layer == 1 ? albedo : layer == 2 ? vec3(light)
    : (normalize(seenFacing) + 1.0) / 2.0;
  color = vec4(clamp(shown, 0.0, 1.0), 1.0);
}`;

// From a camera in OpenCV's axes to WebGL's clip space, column by column. The camera is
// { turn, shift: camera from world; focal, center: in pictures' sides }; `mirror` is -1 for left hands.
function clipOf({ turn, shift, focal, center }, mirror, near = 0.01, far = 10) {
  const rows = [turn.slice(0, 3), turn.slice(3, 6), turn.slice(6, 9)].map((row, at) => [...row, shift[at]]);
  const [x, y, z] = rows;
  const mixed = (a, b, row) => row.map((value, at) => a * value + b * z[at]);
  const across = mixed(2 * focal[0], 2 * center[0] - 1, x).map((value) => mirror * value);
  const up = mixed(-2 * focal[1], 1 - 2 * center[1], y);
  const depth = z.map((value) => (far + near) / (far - near) * value);
  depth[3] -= 2 * far * near / (far - near);
  const clip = new Float32Array(16);
  [across, up, depth, z].forEach((row, at) => row.forEach((value, column) => { clip[4 * column + at] = value; }));
  return clip;
}

class Picture {
  constructor(canvas, hand) {
    this.hand = hand;
    const gl = canvas.getContext("webgl2", { antialias: true, alpha: true, premultipliedAlpha: true });
    if (!gl) throw new Error("this browser has no WebGL2");
    this.gl = gl;
    const shader = poseShader(Array.from(hand.capsule_bones), hand.about.reach);
    this.poser = this.program(shader, NOTHING, ["place", "facing", "light"]);
    this.viewer = this.program(VIEW, COLOR, null);
    this.posed = this.buffer(gl.ARRAY_BUFFER, new Float32Array(7 * hand.count), gl.DYNAMIC_COPY);
    this.restBuffer = this.buffer(gl.ARRAY_BUFFER, hand.rest, gl.DYNAMIC_DRAW);
    const latents = new Float32Array(8 * hand.count);
    latents.set(hand.latents);
    const packed = this.buffer(gl.ARRAY_BUFFER, hand.carry(latents, 8), gl.STATIC_DRAW);
    this.input = this.vertices(this.poser, [
      ["rest", this.restBuffer, 3, gl.FLOAT, 0, 0], ["latents0", packed, 4, gl.FLOAT, 32, 0], ["latents1", packed, 4, gl.FLOAT, 32, 16],
      ["normal", this.bytes(hand.normals), 3, gl.BYTE, 0, 0], ["shares", this.bytes(hand.shares), 4, gl.UNSIGNED_SHORT, 0, 0],
      ["bones", this.bytes(hand.bones), 4, gl.UNSIGNED_BYTE, 0, 0],
    ]);
    const seen = [
      ["place", this.posed, 3, gl.FLOAT, 28, 0], ["facing", this.posed, 3, gl.FLOAT, 28, 12],
      ["light", this.posed, 1, gl.FLOAT, 28, 24], ["albedo", this.bytes(hand.albedo), 3, gl.UNSIGNED_BYTE, 0, 0],
    ];
    if (hand.paint) seen.push(["paint", this.bytes(hand.paint), 4, gl.UNSIGNED_BYTE, 0, 0]);
    this.output = this.vertices(this.viewer, seen);
    // An attribute without an array keeps the value of its place.
    if (!hand.paint) gl.vertexAttrib4f(gl.getAttribLocation(this.viewer, "paint"), 0, 0, 0, 0);
    gl.bindVertexArray(this.output);
    this.buffer(gl.ELEMENT_ARRAY_BUFFER, hand.fine, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    this.feedback = gl.createTransformFeedback();
    gl.bindBufferBase(gl.UNIFORM_BUFFER, 0, this.buffer(gl.UNIFORM_BUFFER, this.network(), gl.STATIC_DRAW));
    gl.uniformBlockBinding(this.poser, gl.getUniformBlockIndex(this.poser, "Network"), 0);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.CULL_FACE);
  }

  program(vertex, fragment, outputs) {
    const gl = this.gl;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    if (outputs) gl.transformFeedbackVaryings(program, outputs, gl.INTERLEAVED_ATTRIBS);
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return program;
  }

  buffer(target, data, usage) {
    const made = this.gl.createBuffer();
    this.gl.bindBuffer(target, made);
    this.gl.bufferData(target, data, usage);
    return made;
  }

  bytes(data) { return this.buffer(this.gl.ARRAY_BUFFER, data, this.gl.STATIC_DRAW); }

  vertices(program, attributes) {
    const gl = this.gl;
    const made = gl.createVertexArray();
    gl.bindVertexArray(made);
    for (const [name, buffer, size, kind, stride, start] of attributes) {
      const at = gl.getAttribLocation(program, name);
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.enableVertexAttribArray(at);
      if (name === "bones") gl.vertexAttribIPointer(at, size, kind, stride, start);
      else gl.vertexAttribPointer(at, size, kind, kind !== gl.FLOAT, stride, start);
    }
    gl.bindVertexArray(null);
    return made;
  }

  // The network's weights as blocks of four by four.
  network() {
    const hand = this.hand;
    const data = [];
    const blocks = (weights, width, columnOf, quads) => {
      for (let at = 0; at < quads; at += 1) {
        for (let row = 0; row < 8; row += 1) {
          for (let column = 0; column < 4; column += 1) {
            const from = columnOf(4 * at + column);
            for (let line = 0; line < 4; line += 1) data.push(from < 0 ? 0 : weights[(4 * row + line) * width + from]);
          }
        }
      }
    };
    // Eight latents, three numbers of the normal and one of nothing, thirty-two of the bones.
    blocks(hand.first_weight, 43, (at) => (at < 11 ? at : at === 11 ? -1 : at - 1), 11);
    blocks(hand.second_weight, 32, (at) => at, 8);
    data.push(...hand.second_bias, ...hand.output_weight, hand.output_bias[0], 0, 0, 0);
    return new Float32Array(data);
  }

  // Skins and lights the hand in a pose; bones of `lifted` cast no shadow.
  pose(posed, lifted) {
    const gl = this.gl;
    const at = (name) => gl.getUniformLocation(this.poser, name);
    gl.useProgram(this.poser);
    gl.uniformMatrix4fv(at("motions"), false, posed.motions);
    gl.uniform4fv(at("capsules"), posed.capsules);
    gl.uniform1fv(at("isShown"), Float32Array.from({ length: BONES }, (_, bone) => (lifted.has(bone) ? 0 : 1)));
    gl.uniform4fv(at("biases"), posed.biases);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.restBuffer);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, posed.rest);
    gl.bindBuffer(gl.ARRAY_BUFFER, null);
    gl.bindVertexArray(this.input);
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, this.feedback);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, this.posed);
    gl.enable(gl.RASTERIZER_DISCARD);
    gl.beginTransformFeedback(gl.POINTS);
    gl.drawArrays(gl.POINTS, 0, this.hand.count);
    gl.endTransformFeedback();
    gl.disable(gl.RASTERIZER_DISCARD);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, null);
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, null);
    gl.bindVertexArray(null);
  }

  clear(alpha) {
    const gl = this.gl;
    gl.clearColor(0, 0, 0, alpha);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  }

  // Draws the posed hand into what is bound. `isMirrored`: the clip space is a mirror's.
  draw(clip, look, isMirrored) {
    const gl = this.gl;
    const at = (name) => gl.getUniformLocation(this.viewer, name);
    gl.useProgram(this.viewer);
    gl.frontFace(isMirrored ? gl.CW : gl.CCW);
    gl.uniformMatrix4fv(at("clip"), false, clip);
    gl.uniform1i(at("layer"), LAYERS.indexOf(look.layer));
    gl.uniform1f(at("gain"), look.gain);
    gl.uniform3fv(at("shift"), look.shift);
    gl.bindVertexArray(this.output);
    gl.drawElements(gl.TRIANGLES, this.hand.fine.length, gl.UNSIGNED_INT, 0);
    gl.bindVertexArray(null);
  }

  // Place, normal and light of every vertex, seven numbers each.
  read() {
    const values = new Float32Array(7 * this.hand.count);
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.posed);
    this.gl.getBufferSubData(this.gl.ARRAY_BUFFER, 0, values);
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, null);
    return values;
  }
}
