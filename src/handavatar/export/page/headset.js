"use strict";
// A headset's tracked hand moves the avatar (WebXR). Its light stays where it was when the session
// began: what was before the capture's camera is before the wearer.

class Headset {
  // `draw` is given { rotations, wrist } and does what a new pose needs; `look` tells the edits.
  constructor(picture, side, draw, look) {
    Object.assign(this, { picture, side, draw, look, session: null });
    const { turn } = picture.hand.about.camera;
    // WebXR looks along -z with y up, the capture's camera along z with y down.
    this.world = product(transposed(turn), [1, 0, 0, 0, -1, 0, 0, 0, -1]);
  }

  static async kind() { // of session, or null
    if (!navigator.xr) return null;
    for (const kind of ["immersive-ar", "immersive-vr"]) if (await navigator.xr.isSessionSupported(kind)) return kind;
    return null;
  }

  async begin(kind, ended) {
    const { gl } = this.picture;
    const session = await navigator.xr.requestSession(kind, { requiredFeatures: ["local", "hand-tracking"] });
    try {
      await gl.makeXRCompatible();
      await session.updateRenderState({ baseLayer: new XRWebGLLayer(session, gl) });
      const space = await session.requestReferenceSpace("local");
      session.addEventListener("end", () => { this.session = null; ended(); });
      const step = (time, frame) => {
        session.requestAnimationFrame(step);
        this.frame(frame, space, kind);
      };
      session.requestAnimationFrame(step);
    } catch (error) {
      await session.end();
      throw error;
    }
    this.session = session;
  }

  frame(frame, space, kind) {
    const { gl } = this.picture;
    const layer = frame.session.renderState.baseLayer;
    const viewer = frame.getViewerPose(space);
    gl.bindFramebuffer(gl.FRAMEBUFFER, layer.framebuffer);
    this.picture.clear(kind === "immersive-ar" ? 0 : 1);
    const source = Array.from(frame.session.inputSources).find(({ hand, handedness }) => hand && handedness === this.side);
    const joints = source && viewer && this.joints(frame, space, source.hand);
    if (joints) {
      const tracked = this.picture.hand.tracked(joints, this.world);
      this.draw(tracked);
      const placed = this.placed(tracked);
      for (const view of viewer.views) {
        const { x, y, width, height } = layer.getViewport(view);
        gl.viewport(x, y, width, height);
        const clip = times(view.projectionMatrix, times(view.transform.inverse.matrix, placed));
        this.picture.draw(clip, this.look(), this.side === "left");
      }
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  // All joints that bones follow, by name; of a left hand as of its mirror image. Null if one is hidden.
  joints(frame, space, hand) {
    const found = {};
    for (const name of this.picture.hand.about.xr.names) {
      const pose = frame.getJointPose(hand.get(name), space);
      if (!pose) return null;
      const { position, orientation } = pose.transform;
      found[name] = this.side === "left" ? mirrored(position, orientation)
        : { place: [position.x, position.y, position.z], turn: ofQuaternion(orientation) };
    }
    return found;
  }

  // From the light's axes to the headset's, the hand as large as the wearer's: column by column.
  placed({ wrist, size }) {
    const sign = this.side === "left" ? -1 : 1;
    const turn = transposed(this.world);
    const shift = applied(turn, wrist.map((value) => (1 - size) * value));
    const [a, b, c, d, e, f, g, h, i] = turn.map((value) => size * value);
    return new Float32Array([sign * a, d, g, 0, sign * b, e, h, 0, sign * c, f, i, 0, sign * shift[0], shift[1], shift[2], 1]);
  }
}

function mirrored({ x, y, z }, orientation) {
  const flip = [-1, 1, 1];
  const turn = ofQuaternion(orientation).map((value, at) => value * flip[Math.floor(at / 3)] * flip[at % 3]);
  return { place: [-x, y, z], turn };
}

function times(a, b) { // four by four, column by column
  const c = new Float32Array(16);
  for (let column = 0; column < 4; column += 1) {
    for (let row = 0; row < 4; row += 1) {
      for (let at = 0; at < 4; at += 1) c[4 * column + row] += a[4 * at + row] * b[4 * column + at];
    }
  }
  return c;
}
