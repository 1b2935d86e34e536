// A headset made of a few objects: one view, one hand whose joints a test sets.
(() => {
  const state = { side: "right", joints: null, frames: 0, session: null };
  const transform = (place, [x, y, z, w]) => ({
    position: { x: place[0], y: place[1], z: place[2] },
    orientation: { x, y, z, w },
  });
  // Looks along -z from half a metre behind the origin of the hand's middle.
  const eye = [0, 0, 0];
  const view = {
    projectionMatrix: new Float32Array([2, 0, 0, 0, 0, 2, 0, 0, 0, 0, -1.0001, -1, 0, 0, -0.02, 0]),
    transform: { inverse: { get matrix() { return new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, -eye[0], -eye[1], -eye[2], 1]); } } },
  };
  class Session extends EventTarget {
    constructor() {
      super();
      this.inputSources = [];
      this.renderState = {};
      this.isOver = false;
    }
    async requestReferenceSpace() { return {}; }
    async updateRenderState(next) { Object.assign(this.renderState, next); }
    requestAnimationFrame(act) {
      if (!this.isOver) setTimeout(() => { if (!this.isOver) { act(0, new Frame(this)); state.frames += 1; } }, 5);
    }
    async end() { this.isOver = true; this.dispatchEvent(new Event("end")); }
  }
  class Frame {
    constructor(session) {
      this.session = session;
      session.inputSources = [
        { handedness: "none" },
        { handedness: state.side, hand: new Map(Object.keys(state.joints).map((name) => [name, name])) },
      ];
    }
    getViewerPose() {
      const [x, y, z] = state.joints.wrist.place;
      Object.assign(eye, [x, y, z + 0.6]);
      return { views: [view] };
    }
    getJointPose(name) {
      const { place, quaternion } = state.joints[name];
      return { transform: transform(place, quaternion) };
    }
  }
  window.XRWebGLLayer = class {
    constructor() { this.framebuffer = null; }
    getViewport() { return { x: 0, y: 0, width: picture.width, height: picture.height }; }
  };
  const xr = {
    async isSessionSupported(kind) { return kind === "immersive-vr"; },
    async requestSession(kind, { requiredFeatures }) {
      if (kind !== "immersive-vr" || !requiredFeatures.includes("hand-tracking")) throw new Error("not asked for hands");
      state.session = new Session();
      return state.session;
    },
  };
  Object.defineProperty(navigator, "xr", { value: xr });
  WebGL2RenderingContext.prototype.makeXRCompatible = async () => {};
  window.fakeWebXr = {
    show(side, joints) { Object.assign(state, { side, joints }); },
    get frames() { return state.frames; },
    size() {
      const { headset, hand } = window.handavatar;
      const joints = headset.joints(new Frame(state.session), null, new Map(Object.keys(state.joints).map((name) => [name, name])));
      return hand.tracked(joints, headset.world).size;
    },
    covered() { // pixels of the last frame that the hand covers
      const { picture: drawn, headset } = window.handavatar;
      const { gl } = drawn;
      headset.frame(new Frame(state.session), null, "immersive-vr");
      const pixels = new Uint8Array(4 * gl.drawingBufferWidth * gl.drawingBufferHeight);
      gl.readPixels(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
      let covered = 0;
      for (let at = 0; at < pixels.length; at += 4) covered += pixels[at] + pixels[at + 1] + pixels[at + 2] > 0;
      return covered;
    },
    end() { return state.session.end(); },
  };
})();
