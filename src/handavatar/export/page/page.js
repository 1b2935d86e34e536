"use strict";
// What a person sees and moves. `window.handavatar` does the same for programs.

const $ = (id) => document.getElementById(id);

function tell(problem) {
  $("problem").hidden = !problem;
  $("problem").textContent = problem;
}

function begin() {
  const about = JSON.parse($("about").textContent);
  const hand = new Hand(about, opened(about, $("arrays").textContent));
  const canvas = $("picture");
  const picture = new Picture(canvas, hand);
  const mirror = about.side === "left" ? -1 : 1;
  const startWrist = turnOf(about.start.rotations[0]);
  const middle = plus(about.start.wrist, applied(startWrist, about.palm));

  // The scene. A pose is given by fingers (relative rotations), the wrist's turn and its place.
  const scene = { rotations: about.start.rotations.map(turnOf), wrist: about.start.wrist, orbit: null };
  let angles = hand.angles(scene.rotations);
  let turn = [0, 0, 0];
  const look = { layer: "rgb", gain: 1, shift: [0, 0, 0], lifted: new Set() };
  let [isPosed, isWaiting, playing] = [false, false, null];
  let headset = null;

  const home = () => { scene.orbit = { azimuth: 0, elevation: 0, zoom: 1, shift: [0, 0] }; };

  function camera() {
    const { azimuth, elevation, zoom, shift } = scene.orbit;
    const base = about.camera;
    const across = turnOf([0, -mirror * azimuth * Math.PI / 180, 0]);
    const over = product(turnOf([-elevation * Math.PI / 180, 0, 0]), across);
    const center = plus(applied(base.turn, middle), base.shift);
    return {
      turn: product(over, base.turn),
      shift: plus(applied(over, minus(base.shift, center)), center),
      focal: base.focal.map((value) => value * zoom),
      center: base.center.map((value, at) => 0.5 + (value - 0.5) * zoom + shift[at] * (at === 0 ? mirror : 1)),
    };
  }

  function draw(view = camera()) {
    if (!isPosed) {
      picture.pose(hand.posed(scene.rotations, scene.wrist), look.lifted);
      isPosed = true;
    }
    picture.gl.viewport(0, 0, canvas.width, canvas.height);
    picture.clear(1);
    picture.draw(clipOf(view, mirror), look, mirror < 0);
  }

  function changed(isPose = true) {
    if (isPose) isPosed = false;
    if (isWaiting || (headset && headset.session)) return;
    isWaiting = true;
    requestAnimationFrame(() => {
      isWaiting = false;
      fit();
      draw();
      canvas.dataset.pictures = Number(canvas.dataset.pictures || 0) + 1;
    });
  }

  function fit() { // the canvas has the screen's pixels
    const side = Math.max(Math.round(canvas.clientWidth * devicePixelRatio), 1);
    if (canvas.width !== side) canvas.width = canvas.height = side;
  }

  function place() { // the hand turned about its middle
    const wrist = product(startWrist, turnOf(turn.map((value) => value * Math.PI / 180)));
    scene.rotations[0] = wrist;
    scene.wrist = minus(middle, applied(wrist, about.palm));
  }

  function bend(next) { // angles in degrees
    angles = next.map((row) => [...row]);
    scene.rotations = hand.bent(angles);
    place();
    changed();
  }

  // ------------------------------------------------------------------ camera

  const clamp = (value, least, greatest) => Math.min(Math.max(value, least), greatest);
  const fingersDown = new Map();

  function move(dx, dy, isShift) {
    const { orbit } = scene;
    if (isShift) {
      orbit.shift = [clamp(orbit.shift[0] + dx, -4, 4), clamp(orbit.shift[1] + dy, -4, 4)];
    } else {
      orbit.azimuth = (orbit.azimuth - 240 * dx) % 360;
      orbit.elevation = clamp(orbit.elevation + 240 * dy, -90, 90);
    }
    changed(false);
  }

  function zoom(factor) {
    scene.orbit.zoom = clamp(scene.orbit.zoom * factor, 0.25, 8);
    changed(false);
  }

  const spread = () => { const [a, b] = [...fingersDown.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingersDown.set(event.pointerId, [event.clientX, event.clientY]);
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = fingersDown.get(event.pointerId);
    if (!last) return;
    const before = fingersDown.size === 2 ? spread() : 0;
    fingersDown.set(event.pointerId, [event.clientX, event.clientY]);
    const step = [event.clientX - last[0], event.clientY - last[1]].map((value) => value / canvas.clientWidth);
    if (fingersDown.size === 2) {
      zoom(spread() / Math.max(before, 1));
      move(step[0] / 2, step[1] / 2, true);
    } else move(...step, event.shiftKey || event.buttons & 6);
  });
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, (event) => fingersDown.delete(event.pointerId));
  }
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(-event.deltaY / 600)); }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (step) move(step[0] / 40, step[1] / 40, event.shiftKey);
    else if (event.key === "+") zoom(1.1);
    else if (event.key === "-") zoom(1 / 1.1);
    else return;
    event.preventDefault();
  });
  addEventListener("resize", () => changed(false));

  // ---------------------------------------------------------------- controls

  function showValue(input) {
    const output = input.nextElementSibling;
    if (output) output.textContent = Number(input.value).toFixed(input.step < 1 ? 2 : 0).replace(/^-0(\.0*)?$/, "0$1");
  }

  function setRange(input, value) {
    input.min = Math.min(input.min, Math.floor(value));
    input.max = Math.max(input.max, Math.ceil(value));
    input.value = value;
    showValue(input);
  }

  function slider(label, least, greatest, value, set) {
    const line = document.createElement("label");
    const input = Object.assign(document.createElement("input"), { type: "range", min: least, max: greatest, step: 1 });
    line.append(label, input, document.createElement("output"));
    input.setAttribute("aria-label", label);
    setRange(input, value);
    input.addEventListener("input", () => { stop(); set(Number(input.value)); showValue(input); });
    return line;
  }

  function group(name, lines, isOpen) {
    const made = document.createElement("details");
    made.dataset.finger = name;
    made.open = isOpen;
    made.append(Object.assign(document.createElement("summary"), { textContent: name }), ...lines);
    return made;
  }

  function showPose() {
    const open = [...document.querySelectorAll("#joints details[open]")].map((one) => one.dataset.finger);
    const fingers = Object.keys(about.fingers).map((finger) => group(finger, about.joints
      .filter((joint) => joint.finger === finger)
      .map(({ label, least, greatest, bone, angle }) => slider(label, least, greatest, angles[bone][angle], (value) => {
        angles[bone][angle] = value;
        bend(angles);
      })), open.includes(finger)));
    const whole = ["roll", "turn", "tilt"].map((label, at) => slider(label, -180, 180, turn[at], (value) => {
      turn[at] = value;
      place();
      changed();
    }));
    $("joints").replaceChildren(...fingers, group("whole hand", whole, open.includes("whole hand")));
  }

  function showLook() {
    setRange($("light"), look.gain);
    ["red", "green", "blue"].forEach((name, at) => setRange($(name), look.shift[at]));
    for (const tick of document.querySelectorAll("#shadows input")) {
      tick.checked = !about.fingers[tick.value].every((bone) => look.lifted.has(bone));
    }
  }

  function unedit() {
    look.gain = about.edit.light_gain;
    look.shift = [...about.edit.albedo_shift];
    look.lifted = new Set(about.edit.lifted_bones);
    showLook();
    changed();
  }

  function unpose() {
    stop();
    turn = [0, 0, 0];
    $("gesture").value = "";
    bend(hand.angles(about.start.rotations.map(turnOf)));
    showPose();
  }

  // ------------------------------------------------------------------ motion

  function stop() {
    playing = null;
    $("play").textContent = "play";
  }

  function atStep(step) {
    const from = 3 * BONES * step;
    scene.rotations = Array.from({ length: BONES }, (_, bone) => turnOf(Array.from(hand.motion_rotations.subarray(from + 3 * bone, from + 3 * bone + 3))));
    scene.wrist = plus(about.joint, hand.motion_translations.subarray(3 * step, 3 * step + 3));
    $("step").value = step;
    showValue($("step"));
    changed();
  }

  function play() {
    const began = performance.now() - 1000 * Number($("step").value) / about.motion.fps;
    const token = {};
    playing = token;
    $("play").textContent = "pause";
    const next = (now) => {
      if (playing !== token) return;
      atStep(Math.max(Math.floor(about.motion.fps * (now - began) / 1000), 0) % about.motion.steps);
      requestAnimationFrame(next);
    };
    requestAnimationFrame(next);
  }

  // -------------------------------------------------------------------- save

  async function save() {
    draw();
    const file = await new Promise((done) => canvas.toBlob(done, "image/png"));
    const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(file), download: `hand-${look.layer}.png` });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60000);
    $("saved").textContent = `saved ${link.download}`;
  }

  // ------------------------------------------------------------------- begin

  function on(id, event, act) {
    $(id).addEventListener(event, async () => {
      try { tell(""); await act(); } catch (error) { tell(error.message); }
    });
  }

  function tick(kind, name, value, isChecked, act) {
    const line = Object.assign(document.createElement("label"), { className: "tick" });
    const input = Object.assign(document.createElement("input"), { type: kind, name, value, checked: isChecked });
    line.append(input, value);
    input.addEventListener("change", () => act(input.checked));
    return line;
  }

  function wire() {
    document.title = about.title;
    $("facts").textContent = about.facts;
    $("layers").append(...LAYERS.map((layer) => tick("radio", "layer", layer, layer === "rgb", () => { look.layer = layer; changed(false); })));
    $("shadows").append(...Object.entries(about.fingers).map(([finger, bones]) => tick("checkbox", "shadow", finger, true, (isShown) => {
      bones.forEach((bone) => (isShown ? look.lifted.delete(bone) : look.lifted.add(bone)));
      changed();
    })));
    on("home", "click", () => { home(); changed(false); });
    on("light", "input", () => { look.gain = Number($("light").value); changed(false); });
    ["red", "green", "blue"].forEach((name, at) => on(name, "input", () => { look.shift[at] = Number($(name).value); changed(false); }));
    on("unedit", "click", unedit);
    const names = Object.keys(about.gestures).map((name) => new Option(name.replaceAll("_", " "), name));
    $("gesture").append(new Option("choose", ""), ...names);
    on("gesture", "change", () => {
      const wish = about.gestures[$("gesture").value];
      if (!wish) return;
      stop();
      bend(wish);
      showPose();
    });
    on("unpose", "click", unpose);
    on("save", "click", save);
    if (about.motion) {
      $("motion").hidden = false;
      $("step").max = about.motion.steps - 1;
      on("step", "input", () => { stop(); atStep(Number($("step").value)); });
      on("play", "click", () => (playing ? stop() : play()));
    }
    for (const input of document.querySelectorAll("input[type=range]")) {
      input.addEventListener("input", () => showValue(input));
    }
    headset = new Headset(picture, about.side, (pose) => picture.pose(hand.posed(pose.rotations, pose.wrist), look.lifted), () => look);
    Headset.kind().then((kind) => {
      if (!kind) return;
      $("headset").hidden = false;
      on("headset", "click", async () => { stop(); await headset.begin(kind, () => changed()); });
    }).catch((error) => tell(error.message));
  }

  // For programs: a picture of given size, pose, camera and look, as RGBA bytes from the bottom row.
  function shot(wish) {
    Object.assign(scene, { rotations: wish.rotations.map(turnOf), wrist: plus(about.joint, wish.translation) });
    Object.assign(look, { layer: "rgb", gain: 1, shift: [0, 0, 0] }, wish.look, { lifted: new Set(wish.lifted) });
    canvas.width = canvas.height = wish.size;
    isPosed = false;
    draw(wish.camera);
    const { gl } = picture;
    const pixels = new Uint8Array(4 * wish.size * wish.size);
    gl.readPixels(0, 0, wish.size, wish.size, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    return pixels;
  }

  home();
  wire();
  showPose();
  unedit();
  window.handavatar = { about, hand, picture, headset, shot };
}

try { begin(); } catch (error) { tell(error.message); throw error; }
