"use strict";
// The page keeps the whole scene and sends it with every wish for a picture; the server keeps none.

const $ = (id) => document.getElementById(id);
const canvas = $("picture");
const pen = canvas.getContext("2d");
const client = Array.from(crypto.getRandomValues(new Uint8Array(12)), (b) => b.toString(16).padStart(2, "0")).join("");

let about = null;
let order = 0;          // of the newest wish
let waiting = null;     // ends the wait of the loop below
let refining = null;    // aborts a slow picture that is no longer wanted
let playing = false;
let motion = { fps: 30, steps: 0 };
let film = null;
const scene = { moment: null, angles: null, turn: [0, 0, 0], orbit: null, layer: "rgb", size: 256, touches: null };

async function ask(path, body, signal) {
  const isFile = body instanceof Blob;
  const options = body === undefined ? { signal }
    : { method: "POST", headers: { "Content-Type": isFile ? "image/png" : "application/json" }, body: isFile ? body : JSON.stringify(body), signal };
  const answer = await fetch(path, options);
  if (answer.ok) return answer;
  let why = answer.statusText;
  try { why = (await answer.json()).error; } catch { /* the status says enough */ }
  throw new Error(why);
}

function tell(problem) {
  $("problem").hidden = !problem;
  $("problem").textContent = problem;
}

// ------------------------------------------------------------------ pictures

function changed() {
  order += 1;
  if (refining) refining.abort();
  if (waiting) waiting();
}

async function show(answer) {
  const bitmap = await createImageBitmap(await answer.blob());
  if (canvas.width !== scene.size) canvas.width = canvas.height = scene.size;
  pen.imageSmoothingQuality = "high";
  pen.drawImage(bitmap, 0, 0, canvas.width, canvas.height);
  bitmap.close();
}

async function drawForever() {
  let drawn = 0;
  let rate = 0;
  for (;;) {
    if (drawn === order) await new Promise((wake) => { waiting = wake; });
    waiting = null;
    const wish = order;
    try {
      for (let stage = 0; stage < about.stages.length && wish === order; stage += 1) {
        if (stage > 0 && playing) break;
        const begin = performance.now();
        refining = stage > 0 ? new AbortController() : null;
        const answer = await ask("picture", { client, order: wish, stage, scene }, refining?.signal);
        if (answer.status === 204) break;
        if (stage > 0 && wish !== order) break;
        await show(answer);
        const milliseconds = performance.now() - begin;
        rate = stage === 0 ? 0.8 * rate + 0.2 * (1000 / milliseconds) : rate;
        canvas.dataset.stage = about.stages[stage];
        canvas.dataset.order = wish;
        canvas.dataset.milliseconds = milliseconds.toFixed(1);
        canvas.dataset.pictures = Number(canvas.dataset.pictures || 0) + 1;
        $("state").textContent = stage === 0 ? `fluid, ${rate.toFixed(0)} pictures a second`
          : `${about.stages[stage]}, ${(milliseconds / 1000).toFixed(1)} s`;
        tell("");
      }
      drawn = wish;
    } catch (error) {
      if (error.name !== "AbortError") {
        tell(error instanceof TypeError ? "the server does not answer; asking again" : error.message);
        await new Promise((wake) => setTimeout(wake, 700));
        // A wish that means nothing stays so; one that nobody answered is repeated.
        if (error instanceof TypeError || /again/.test(error.message)) continue;
      }
      drawn = wish;
    } finally {
      refining = null;
    }
  }
}

// -------------------------------------------------------------------- camera

function home() {
  scene.orbit = { azimuth: 0, elevation: 0, zoom: 1, shift: [0, 0] };
}

const clamp = (value, least, greatest) => Math.min(Math.max(value, least), greatest);
const places = new Map();

function moveCamera(dx, dy, isShift) {
  const width = canvas.clientWidth;
  if (isShift) {
    scene.orbit.shift = [clamp(scene.orbit.shift[0] + dx / width, -4, 4), clamp(scene.orbit.shift[1] + dy / width, -4, 4)];
  } else {
    scene.orbit.azimuth = (scene.orbit.azimuth - 240 * dx / width) % 360;
    scene.orbit.elevation = clamp(scene.orbit.elevation + 240 * dy / width, -90, 90);
  }
  changed();
}

function zoom(factor) {
  scene.orbit.zoom = clamp(scene.orbit.zoom * factor, 0.25, 8);
  changed();
}

// Once there is something to move.
function wireCanvas() {
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    places.set(event.pointerId, [event.clientX, event.clientY]);
    if ($("painting").checked) paintAt(event);
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = places.get(event.pointerId);
    if (!last) return;
    places.set(event.pointerId, [event.clientX, event.clientY]);
    const [dx, dy] = [event.clientX - last[0], event.clientY - last[1]];
    if ($("painting").checked) paintAt(event);
    else if (places.size === 2) zoom(Math.exp(-dy / 200));
    else if (dx || dy) moveCamera(dx, dy, event.shiftKey || event.buttons & 6);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => places.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 600));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (step) moveCamera(step[0] * canvas.clientWidth / 40, step[1] * canvas.clientWidth / 40, event.shiftKey);
    else if (event.key === "+") zoom(1.1);
    else if (event.key === "-") zoom(1 / 1.1);
    else return;
    event.preventDefault();
  });
}

// --------------------------------------------------------------------- edits

let picking = false;
let picks = 0;

async function paintAt(event) {
  if (picking || scene.touches.strokes.length >= 400) return;
  const box = canvas.getBoundingClientRect();
  const [x, y] = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  if (x < 0 || x > 1 || y < 0 || y > 1) return;
  picking = true;
  try {
    picks += 1;
    const answer = await ask("pick", { client, order: picks, scene, x, y });
    if (answer.status !== 200) return;
    const { anchor } = await answer.json();
    const last = scene.touches.strokes.at(-1);
    const radius = Number($("radius").value);
    const color = [1, 3, 5].map((at) => parseInt($("color").value.slice(at, at + 2), 16) / 255);
    if (anchor === null || (last && last.anchor === anchor && last.radius === radius && String(last.color) === String(color))) return;
    scene.touches.strokes.push({ anchor, radius, color });
    changed();
  } catch (error) {
    tell(error.message);
  } finally {
    picking = false;
  }
}

async function paintPicture() {
  const input = $("paint-picture");
  const [file] = input.files;
  input.value = "";  // The same file, changed meanwhile, can be chosen again.
  if (!file) return;
  if (file.size > about.most_picture_bytes) throw new Error(`${file.name} has ${file.size} bytes, at most ${about.most_picture_bytes} are taken`);
  if (scene.touches.strokes.length >= 400) throw new Error("that is all the paint there is: undo some");
  scene.touches.strokes.push(await (await ask("paint", file)).json());
  said(`painted with ${file.name}`);
  changed();
}

function showTouches() {
  const { light_gain: gain, albedo_shift: shift, lift_shadow: lifted, light: clip } = scene.touches;
  $("clip").value = clip;
  setRange($("light"), gain);
  ["red", "green", "blue"].forEach((name, at) => setRange($(name), shift[at]));
  for (const tick of document.querySelectorAll("#shadows input")) {
    tick.checked = !about.finger_bones[tick.value].every((bone) => lifted.includes(bone));
  }
}

function setRange(input, value) {
  input.min = Math.min(input.min, value);
  input.max = Math.max(input.max, value);
  input.value = value;
  showValue(input);
}

function showValue(input) {
  const output = input.nextElementSibling;
  if (output && output.tagName === "OUTPUT") output.textContent = Number(input.value).toFixed(input.step < 1 ? 2 : 0).replace(/^-0(\.0*)?$/, "0$1");
}

// ---------------------------------------------------------------------- pose

function jointSlider(label, least, greatest, value, set) {
  const line = document.createElement("label");
  const input = document.createElement("input");
  Object.assign(input, { type: "range", min: least, max: greatest, step: 1 });
  line.append(label, input, document.createElement("output"));
  input.setAttribute("aria-label", label);
  setRange(input, value);
  input.addEventListener("input", () => { set(Number(input.value)); showValue(input); changed(); });
  return line;
}

function showPose(angles) {
  const open = [...document.querySelectorAll("#joints details[open]")].map((group) => group.dataset.finger);
  const groups = about.fingers.map((finger) => {
    const group = document.createElement("details");
    group.dataset.finger = finger;
    group.open = open.includes(finger);
    group.append(Object.assign(document.createElement("summary"), { textContent: finger }));
    for (const joint of about.joints.filter((one) => one.finger === finger)) {
      group.append(jointSlider(joint.label, joint.least, joint.greatest, angles[joint.bone][joint.angle], (value) => {
        stop();
        scene.angles = scene.angles || angles;
        scene.angles[joint.bone][joint.angle] = value;
      }));
    }
    return group;
  });
  const turning = document.createElement("details");
  turning.dataset.finger = "hand";
  turning.open = open.includes("hand");
  turning.append(Object.assign(document.createElement("summary"), { textContent: "whole hand" }));
  ["roll", "turn", "tilt"].forEach((label, at) => turning.append(
    jointSlider(label, -180, 180, scene.turn[at], (value) => { stop(); scene.turn[at] = value; })));
  $("joints").replaceChildren(...groups, turning);
}

const copyOf = (angles) => angles.map((row) => [...row]);

// -------------------------------------------------------------------- motion

function stop() {
  playing = false;
  $("play").textContent = "play";
}

function atStep(step) {
  $("step").value = step;
  showValue($("step"));
  scene.moment = { motion: $("motion").value, step };
  scene.angles = null;
  changed();
}

async function showAngles() {
  if (!scene.moment || scene.angles) return;
  const { motion: name, step } = scene.moment;
  const answer = await ask(`angles?motion=${encodeURIComponent(name)}&step=${step}`);
  const { angles } = await answer.json();
  if (scene.moment && scene.moment.step === step && !scene.angles) showPose(angles);
}

async function play() {
  playing = true;
  $("play").textContent = "pause";
  const begin = performance.now();
  const first = Number($("step").value) % Math.max(motion.steps - 1, 1);
  while (playing) {
    const step = Math.floor(first + motion.fps * (performance.now() - begin) / 1000) % motion.steps;
    if (Number(canvas.dataset.order || 0) >= order && step !== scene.moment?.step) atStep(step);
    await new Promise((wake) => requestAnimationFrame(wake));
  }
  changed();
  showAngles().catch((error) => tell(error.message));
}

// ---------------------------------------------------------------------- save

function download(data, name) {
  const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(data), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}

function said(text) { $("saved").textContent = text; }

async function savePicture() {
  const wish = JSON.parse(JSON.stringify(scene));
  said("making the picture in full");
  // As another client: what is dragged meanwhile does not overtake it.
  const answer = await ask("picture", { client: `${client} save`, order: Date.now(), stage: about.stages.length - 1, scene: wish });
  if (answer.status !== 200) return;
  download(await answer.blob(), `hand-${wish.layer}.png`);
  said(`saved hand-${wish.layer}.png`);
}

async function saveFilm() {
  const stage = Number($("film-stage").value);
  const begun = await (await ask("film", { scene, stage })).json();
  film = begun.name;
  $("stop-film").hidden = false;
  try {
    for (;;) {
      const progress = await (await ask(`film?name=${film}`)).json();
      if (progress.state === "finished") break;
      if (progress.state !== "running") throw new Error(progress.why);
      said(`video: picture ${progress.done} of ${progress.total}`);
      await new Promise((wake) => setTimeout(wake, 400));
    }
    const name = `${$("motion").value.replace(/[^\w-]+/g, "_")}-${scene.layer}.mp4`;
    download(await (await ask(`film.mp4?name=${film}`)).blob(), name);
    said(`saved ${name}`);
  } finally {
    film = null;
    $("stop-film").hidden = true;
  }
}

async function saveAvatar() {
  const { path } = await (await ask("avatar", { touches: scene.touches })).json();
  said(`saved ${path}`);
}

// --------------------------------------------------------------------- begin

function on(id, event, act) {
  $(id).addEventListener(event, async () => {
    try { await act(); } catch (error) { said(""); tell(error.message); }
  });
}

function wire() {
  wireCanvas();
  for (const layer of about.layers) {
    const line = Object.assign(document.createElement("label"), { className: "tick" });
    const input = Object.assign(document.createElement("input"), { type: "radio", name: "layer", value: layer, checked: layer === "rgb" });
    line.append(input, layer);
    if (layer === "unseen") line.title = "in violet: skin that no picture of the video showed; how it looks there is a guess";
    input.addEventListener("change", () => { scene.layer = layer; changed(); });
    $("layers").append(line);
  }
  for (const finger of about.fingers) {
    const line = Object.assign(document.createElement("label"), { className: "tick" });
    const input = Object.assign(document.createElement("input"), { type: "checkbox", value: finger });
    line.append(input, finger);
    input.addEventListener("change", () => {
      const own = about.finger_bones[finger];
      const others = scene.touches.lift_shadow.filter((bone) => !own.includes(bone));
      scene.touches.lift_shadow = input.checked ? others : [...others, ...own];
      changed();
    });
    $("shadows").append(line);
  }
  for (const size of about.sizes) $("size").append(new Option(`${size} x ${size}`, size, false, size === scene.size));
  $("gesture").append(new Option("choose", ""), ...Object.keys(about.gestures).map((name) => new Option(name.replaceAll("_", " "), name)));
  $("motion").append(...about.motions.map((name) => new Option(name, name)));

  $("lights").hidden = about.lights < 2;
  $("clip").append(...Array.from({ length: about.lights }, (_, clip) => new Option(`clip ${clip}`, clip)));

  on("clip", "change", () => { scene.touches.light = Number($("clip").value); changed(); });
  on("size", "change", () => { scene.size = Number($("size").value); changed(); });
  on("home", "click", () => { home(); changed(); });
  on("light", "input", () => { scene.touches.light_gain = Number($("light").value); changed(); });
  ["red", "green", "blue"].forEach((name, at) => on(name, "input", () => { scene.touches.albedo_shift[at] = Number($(name).value); changed(); }));
  on("painting", "change", () => canvas.classList.toggle("painting", $("painting").checked));
  on("paint-picture", "change", paintPicture);
  on("undo", "click", () => { scene.touches.strokes.pop(); changed(); });
  on("wipe", "click", () => { scene.touches.strokes = []; changed(); });
  on("unedit", "click", () => { scene.touches = structuredClone(about.touches); showTouches(); changed(); });
  on("gesture", "change", () => {
    const angles = about.gestures[$("gesture").value];
    if (!angles) return;
    stop();
    scene.angles = copyOf(angles);
    showPose(scene.angles);
    changed();
  });
  on("unpose", "click", () => {
    stop();
    Object.assign(scene, { moment: null, angles: null, turn: [0, 0, 0] });
    $("motion").value = $("gesture").value = "";
    $("step").disabled = $("play").disabled = $("save-film").disabled = true;
    showPose(copyOf(about.angles));
    changed();
  });
  on("motion", "change", async () => {
    stop();
    const name = $("motion").value;
    $("step").disabled = $("play").disabled = $("save-film").disabled = !name;
    if (!name) { scene.moment = null; changed(); return; }
    motion = await (await ask(`motion?name=${encodeURIComponent(name)}`)).json();
    $("step").max = motion.steps - 1;
    atStep(0);
    await showAngles();
  });
  on("step", "input", () => { stop(); atStep(Number($("step").value)); });
  on("step", "change", showAngles);
  on("play", "click", () => (playing ? stop() : play()));
  on("save-picture", "click", savePicture);
  on("save-avatar", "click", saveAvatar);
  on("save-film", "click", saveFilm);
  on("stop-film", "click", () => ask("film/cancel", { name: film }));
  for (const input of document.querySelectorAll("input[type=range]")) {
    input.addEventListener("input", () => showValue(input));
    showValue(input);
  }
}

async function begin() {
  about = await (await ask("about")).json();
  home();
  scene.touches = structuredClone(about.touches);
  document.title = about.subject ? `HandAvatar: ${about.subject}` : "HandAvatar";
  wire();
  showTouches();
  showPose(copyOf(about.angles));
  changed();
  drawForever();
}

begin().catch((error) => tell(error.message));
