"use strict";
// The page of a training: asks how far it is, and draws the avatar anew whenever there is a newer one.

const $ = (id) => document.getElementById(id);
const client = Array.from(crypto.getRandomValues(new Uint8Array(12)), (b) => b.toString(16).padStart(2, "0")).join("");
const LAYERS = ["rgb", "albedo", "illumination", "normal", "mesh"];
const STAGES = ["fluid", "half size", "full"];
const STRIP = 24;       // thumbnails, evenly spread
const TELL_EVERY = 1500;
const PATIENCE = 8000;
const DRAW_CURVES_EVERY = 3000;

let about = null;
let order = 0;          // of the newest wish
let waiting = null;     // ends the wait of the loop below
let refining = null;    // aborts a picture that is no longer wanted
let hasChosenLayer = false;
const view = { frame: 0, layer: "mesh", size: 256 };

const sleep = (milliseconds) => new Promise((wake) => setTimeout(wake, milliseconds));

async function ask(path, body, signal) {
  const options = body === undefined ? { signal }
    : { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body), signal };
  const answer = await fetch(path, options);
  if (answer.ok) return answer;
  // The server has gone over to the finished avatar.
  if (answer.status === 404) location.reload();
  let why = answer.statusText;
  try { why = (await answer.json()).error; } catch { /* the status says enough */ }
  throw new Error(why);
}

function tell(problem) {
  $("problem").hidden = !problem;
  $("problem").textContent = problem;
}

function duration(seconds) {
  if (seconds === null) return "time left unknown";
  const whole = Math.round(seconds);
  const two = (value) => String(value).padStart(2, "0");
  if (whole < 60) return `${whole} s left`;
  if (whole < 3600) return `${Math.floor(whole / 60)}:${two(whole % 60)} min left`;
  return `${Math.floor(whole / 3600)}:${two(Math.floor(whole % 3600 / 60))} h left`;
}

// ------------------------------------------------------------------- how far

function showProgress() {
  if (about.phase === "waiting") {
    $("job").textContent = `waiting for the training in ${about.run} to begin`;
    return;
  }
  const speed = `${about.steps_per_second.toFixed(about.steps_per_second < 10 ? 1 : 0)} steps/s`;
  const figures = Object.entries(about.figures).map(([name, value]) => `${name} ${value}`);
  const where = about.job ? `${about.job}: step ${about.step} of ${about.total}` : "training begins";
  const parts = about.phase === "stopped" ? [where, "training has stopped; the same command goes on from there"]
    : !about.job ? [where]
      : [`${Math.round(100 * about.share)} %`, where, speed, duration(about.seconds_left), ...figures];
  $("job").textContent = parts.join("   ");
  $("job").dataset.phase = about.phase;
  $("job").dataset.job = about.job;
  $("job").dataset.step = about.step;
  $("bar").max = 1;
  $("bar").value = about.share;
  document.title = about.job ? `${about.job} ${about.step}/${about.total}` : "HandAvatar: training";
}

function showFrames() {
  const last = about.frames - 1;
  if (!about.frames || $("frames").childElementCount) return;
  $("number").max = last;
  const count = Math.min(STRIP, about.frames);
  for (let place = 0; place < count; place += 1) {
    const frame = count > 1 ? Math.round(place * last / (count - 1)) : 0;
    const tile = Object.assign(document.createElement("canvas"), { width: 64, height: 64, tabIndex: 0 });
    tile.setAttribute("role", "option");
    tile.setAttribute("aria-label", `frame ${frame}`);
    tile.dataset.frame = frame;
    const choose = () => { $("number").value = frame; chosen(); };
    tile.addEventListener("click", choose);
    tile.addEventListener("keydown", (event) => { if (event.key === "Enter") choose(); });
    $("frames").append(tile);
  }
  markFrame();
  drawTiles();
}

async function drawTiles() {
  // The avatar first: where cores are busy every picture waits for its turn.
  for (let waited = 0; waited < 20 && !$("picture").dataset.version; waited += 1) await sleep(500);
  let number = 0;
  for (const tile of $("frames").children) {
    number += 1;
    const wish = { client: `${client} tile`, order: number, view: { frame: Number(tile.dataset.frame), size: 64 } };
    try { await draw(tile, await ask("frame", wish)); } catch (error) { tell(error.message); }
  }
}

function markFrame() {
  for (const tile of $("frames").children) tile.setAttribute("aria-selected", Number(tile.dataset.frame) === view.frame);
  $("number").nextElementSibling.textContent = view.frame;
}

async function follow() {
  for (;;) {
    try {
      const before = about?.avatar;
      about = await (await ask("training")).json();
      showProgress();
      if (about.phase !== "waiting") showFrames();
      // Colours are learned last; until then the shape is what there is to see.
      if (about.avatar && !hasChosenLayer) setLayer(about.job === "train" ? "rgb" : "mesh");
      if (about.frames && (order === 0 || about.avatar !== before)) renewed();
      tell("");
    } catch (error) {
      tell(error instanceof TypeError ? "the server does not answer; asking again" : error.message);
    }
    await sleep(TELL_EVERY);
  }
}

// ------------------------------------------------------------------ pictures

async function draw(canvas, answer) {
  if (answer.status === 204) return false;
  const bitmap = await createImageBitmap(await answer.blob());
  const pen = canvas.getContext("2d");
  pen.imageSmoothingQuality = "high";
  pen.drawImage(bitmap, 0, 0, canvas.width, canvas.height);
  bitmap.close();
  return true;
}

function setLayer(layer) {
  view.layer = layer;
  document.querySelector(`input[name=layer][value=${layer}]`).checked = true;
}

// A newer avatar: what is being made is finished first, unless it is a full picture and takes long. Where no
// core is idle, half a picture may take longer than a newer avatar, and would never be seen.
function renewed() {
  order = Math.max(order, 1);
  if (refining && refining.stage > 1 && performance.now() - refining.begun > PATIENCE) refining.abort();
  if (waiting) waiting();
}

// A person's wish: what is being made is dropped.
function chosen() {
  view.frame = Number($("number").value);
  order += 1;
  markFrame();
  if (refining) refining.abort();
  if (waiting) waiting();
}

async function drawForever() {
  let framed = "";
  let wish = 0;
  let drawn = null;
  for (;;) {
    // A wish may be older than the first answer of how far the training is.
    while (!about?.frames || (wish === order && drawn === about.avatar)) await new Promise((wake) => { waiting = wake; });
    waiting = null;
    wish = order;
    const wanted = { ...view };
    const version = about.avatar;
    refining = new AbortController();
    try {
      for (const canvas of [$("frame"), $("picture")]) if (canvas.width !== wanted.size) canvas.width = canvas.height = wanted.size;
      if (framed !== `${wanted.frame} ${wanted.size}`) {
        await draw($("frame"), await ask("frame", { client, order: wish, view: wanted }, refining.signal));
        framed = `${wanted.frame} ${wanted.size}`;
        $("frame-name").textContent = `training frame ${wanted.frame} of ${about.frames}`;
        $("frame").dataset.frame = wanted.frame;
      }
      for (let stage = 0; version !== null && stage <= Number($("detail").value); stage += 1) {
        if (wish !== order || (stage > 1 && version !== about.avatar)) break;
        const begin = performance.now();
        Object.assign(refining, { stage, begun: begin });
        const answer = await ask("picture", { client, order: wish, stage, view: wanted }, refining.signal);
        if (!await draw($("picture"), answer)) break;
        Object.assign($("picture").dataset, { stage, version, order: wish, frame: wanted.frame });
        $("state").textContent = `the avatar at ${answer.headers.get("Avatar")}, ${STAGES[stage]} in ${((performance.now() - begin) / 1000).toFixed(1)} s`;
      }
      drawn = version;
    } catch (error) {
      if (error.name !== "AbortError") {
        tell(error instanceof TypeError ? "the server does not answer; asking again" : error.message);
        await sleep(1500);
      }
    } finally {
      refining = null;
    }
  }
}

// -------------------------------------------------------------------- curves

const SVG = "http://www.w3.org/2000/svg";

function shape(name, attributes) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

function chart(title, points) {
  const [width, height] = [300, 74];
  const values = points.map((point) => point[1]);
  // Losses fall by factors: equal factors are equally high. PSNR is a logarithm already.
  const scale = title.endsWith("psnr") || Math.min(...values) <= 0 ? (value) => value : Math.log;
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const [first, last] = [points[0][0], points.at(-1)[0]];
  const x = (step) => width * (step - first) / Math.max(last - first, 1);
  const y = (value) => 4 + (height - 8) * (1 - (scale(value) - scale(low)) / Math.max(scale(high) - scale(low), 1e-9));
  const figure = document.createElement("figure");
  figure.className = "chart";
  figure.dataset.curve = title;
  figure.dataset.points = points.length;
  const caption = document.createElement("figcaption");
  caption.append(title, Object.assign(document.createElement("b"), { textContent: Number(values.at(-1).toPrecision(3)) }));
  const drawing = shape("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${title}, now ${values.at(-1)}` });
  drawing.append(shape("polyline", { points: points.map(([step, value]) => `${x(step).toFixed(1)},${y(value).toFixed(1)}`).join(" ") }));
  const range = document.createElement("small");
  range.append(`steps ${Math.round(first)} to ${Math.round(last)}`, Object.assign(document.createElement("span"), { textContent: `${low.toPrecision(3)} to ${high.toPrecision(3)}` }));
  figure.append(caption, drawing, range);
  return figure;
}

async function drawCurves() {
  for (;;) {
    try {
      const { jobs } = await (await ask("curves")).json();
      // The newest job first; of the training, the loss and the PSNR before their parts.
      const rank = (name) => ["loss", "psnr"].indexOf(name) + 1 || 3;
      $("charts").replaceChildren(...Object.entries(jobs).reverse().flatMap(([job, curves]) => Object.entries(curves)
        .sort(([one], [other]) => rank(one) - rank(other))
        .filter(([, points]) => points.length > 1)
        .map(([name, points]) => chart(`${job}: ${name}`, points))));
    } catch { /* the other loop says that the server does not answer */ }
    await sleep(DRAW_CURVES_EVERY);
  }
}

// --------------------------------------------------------------------- begin

for (const layer of LAYERS) {
  const line = Object.assign(document.createElement("label"), { className: "tick" });
  const input = Object.assign(document.createElement("input"), { type: "radio", name: "layer", value: layer, checked: layer === view.layer });
  line.append(input, layer);
  input.addEventListener("change", () => { hasChosenLayer = true; view.layer = layer; chosen(); });
  $("layers").append(line);
}
$("number").addEventListener("input", chosen);
$("detail").addEventListener("change", chosen);
$("size").addEventListener("change", () => { view.size = Number($("size").value); chosen(); });
follow();
drawForever();
drawCurves();
