"use strict";
// The page of a webcam: shows the camera, sends small pictures of it, and records what the capture is made of.

const $ = (id) => document.getElementById(id);
const client = Array.from(crypto.getRandomValues(new Uint8Array(12)), (b) => b.toString(16).padStart(2, "0")).join("");
const FINGERS = [1, 5, 9, 13, 17].map((base) => [0, base, base + 1, base + 2, base + 3]);
const KINDS = ["video/webm;codecs=vp8", "video/webm;codecs=vp9", "video/webm", "video/mp4"];
const BITS = 12e6;            // a second, of the recording
const PIECE_EVERY = 1000;     // milliseconds
const MAP_EVERY = 1500;
const WHY = {
  NotAllowedError: "The browser may not use the camera. Allow it for this page (the sign of a camera beside the address), then try again.",
  NotFoundError: "There is no camera. Plug one in, then try again.",
  NotReadableError: "The camera cannot be read: another program may be using it. Close that one, then try again.",
  OverconstrainedError: "The camera that was chosen is gone. Choose another one, then try again.",
};

let about = null;
let stream = null;
let order = 0;                // of the newest picture that was sent
let shown = 0;                // of the newest answer that was drawn
let isOver = false;           // the recording is whole: nothing more is sent
const ending = new AbortController();
let frame = 0;                // number of the camera's newest picture
const times = [];             // of the last answers
let recorder = null;
const small = document.createElement("canvas");

const sleep = (milliseconds) => new Promise((wake) => setTimeout(wake, milliseconds));

async function ask(path, options) {
  const answer = await fetch(path, { ...options, signal: ending.signal });
  if (answer.ok) return answer;
  let why = answer.statusText;
  try { why = (await answer.json()).error; } catch { /* the status says enough */ }
  throw Object.assign(new Error(why), { status: answer.status });
}

const post = (path, body, kind) => ask(path, { method: "POST", headers: { "Content-Type": kind }, body });
const postJson = (path, value) => post(path, JSON.stringify({ client, ...value }), "application/json");

function tell(problem) {
  $("problem").hidden = !problem;
  $("problem").textContent = problem;
}

function explain(error) {
  return error instanceof TypeError ? "The server does not answer: is the command still running in the terminal?" : error.message;
}

// -------------------------------------------------------------------- camera

async function openCamera() {
  $("again").hidden = true;
  if (!navigator.mediaDevices?.getUserMedia) {
    tell("This browser gives no camera to pages of other machines. Open the page on the machine that has the camera, with the ssh line that the terminal prints.");
    return;
  }
  const chosen = $("cameras").value;
  try {
    for (const track of stream?.getTracks() ?? []) track.stop();
    stream = await navigator.mediaDevices.getUserMedia({
      audio: false,
      video: { width: { ideal: 1280 }, height: { ideal: 720 }, frameRate: { ideal: 30 }, ...(chosen && { deviceId: { exact: chosen } }) },
    });
    for (const track of stream.getTracks()) track.addEventListener("ended", () => {
      tell("The camera was unplugged or taken away. Try again.");
      $("again").hidden = false;
    });
    $("camera").srcObject = stream;
    await $("camera").play();
    const { videoWidth: width, videoHeight: height } = $("camera");
    const scale = Math.min(1, about.longer_side / Math.max(width, height));
    small.width = Math.round(width * scale);
    small.height = Math.round(height * scale);
    $("overlay").width = small.width;
    $("overlay").height = small.height;
    $("record").disabled = !kindOfRecording();
    if (about.records && !kindOfRecording()) tell("This browser cannot record video: use another one, or record with the camera's own program and run handavatar capture video.");
    else tell("");
    await listCameras();
  } catch (error) {
    tell(WHY[error.name] ?? `The camera cannot be opened (${error.name}: ${error.message}). Try again.`);
    $("again").hidden = false;
    $("instruction").textContent = "No camera.";
  }
}

async function listCameras() {
  const devices = (await navigator.mediaDevices.enumerateDevices()).filter((device) => device.kind === "videoinput");
  const current = stream.getVideoTracks()[0]?.getSettings().deviceId;
  $("cameras").replaceChildren(...devices.map((device, number) => new Option(device.label || `camera ${number + 1}`, device.deviceId, false, device.deviceId === current)));
}

function countFrames() {
  const count = () => { frame += 1; $("camera").requestVideoFrameCallback(count); };
  if ("requestVideoFrameCallback" in HTMLVideoElement.prototype) $("camera").requestVideoFrameCallback(count);
  else setInterval(() => { frame += 1; }, 33);
}

// -------------------------------------------------------------------- follow

let sent = 0;                 // number of the camera's picture that was sent last

async function follow() {
  while (!isOver) {
    if (!stream?.active || frame === sent || $("camera").readyState < 2) { await sleep(5); continue; }
    sent = frame;
    order += 1;
    const mine = order;
    const pen = small.getContext("2d");
    pen.drawImage($("camera"), 0, 0, small.width, small.height);
    const moment = (performance.now() / 1000).toFixed(4);
    const begin = performance.now();
    const picture = await new Promise((done) => small.toBlob(done, "image/jpeg", 0.9));
    try {
      const answer = await post(`look?client=${client}&order=${mine}&time=${moment}`, picture, "image/jpeg");
      if (answer.status === 200) await show(await answer.json(), begin);
      if ($("problem").dataset.from === "look") { tell(""); $("problem").dataset.from = ""; }
    } catch (error) {
      if (isOver) return;
      tell(explain(error));
      $("problem").dataset.from = "look";
      await sleep(1000);
    }
    await sleep(1000 * about.every - (performance.now() - begin));
  }
}

async function show(seen, begin) {
  if (seen.order < shown) return;
  shown = seen.order;
  times.push(performance.now());
  while (times.length > 20) times.shift();
  const rate = times.length > 1 ? 1000 * (times.length - 1) / (times.at(-1) - times[0]) : 0;
  const parts = [seen.side ? `${seen.side} hand` : "no hand", `${rate.toFixed(1)} pictures a second`, `${Math.round(performance.now() - begin)} ms behind`];
  $("state").textContent = parts.join("   ");
  Object.assign($("state").dataset, { order: seen.order, rate: rate.toFixed(2), side: seen.side ?? "", server: JSON.stringify(seen.milliseconds) });
  $("instruction").textContent = seen.instruction;
  $("warnings").replaceChildren(...seen.warnings.map((warning) => {
    const line = document.createElement("li");
    line.dataset.kind = warning.kind;
    line.append(Object.assign(document.createElement("b"), { textContent: warning.found }), `: ${warning.remedy}`);
    return line;
  }));
  for (const line of $("steps").children) {
    const share = seen.steps[line.dataset.step];
    line.querySelector("progress").value = share;
    line.classList.toggle("done", share >= 1);
  }
  $("share").textContent = `${Math.round(100 * seen.seen_share)} % of the skin`;
  drawMarks(seen);
  if (about.drives) await drawAvatar(seen);
}

function drawMarks(seen) {
  const pen = $("overlay").getContext("2d");
  const { width, height } = $("overlay");
  pen.clearRect(0, 0, width, height);
  if (!$("marks").checked || !seen.landmarks.length) return;
  seen.dots.forEach(([x, y], number) => {
    pen.fillStyle = seen.are_seen[number] ? "rgba(92, 214, 122, .85)" : "rgba(255, 140, 90, .85)";
    pen.beginPath();
    pen.arc(x, y, width / 260, 0, 2 * Math.PI);
    pen.fill();
  });
  pen.lineWidth = width / 320;
  pen.strokeStyle = seen.is_counted ? "rgba(235, 240, 255, .8)" : "rgba(255, 180, 168, .9)";
  for (const chain of FINGERS) {
    pen.beginPath();
    chain.forEach((landmark, place) => pen[place ? "lineTo" : "moveTo"](...seen.landmarks[landmark]));
    pen.stroke();
  }
}

async function drawAvatar(seen) {
  $("avatar").classList.toggle("lost", !seen.avatar);
  if (!seen.avatar) return;
  const bytes = Uint8Array.from(atob(seen.avatar), (letter) => letter.charCodeAt(0));
  const bitmap = await createImageBitmap(new Blob([bytes], { type: "image/jpeg" }));
  if ($("avatar").width !== bitmap.width || $("avatar").height !== bitmap.height) Object.assign($("avatar"), { width: bitmap.width, height: bitmap.height });
  $("avatar").getContext("2d").drawImage(bitmap, 0, 0);
  $("avatar").dataset.order = seen.order;
  bitmap.close();
}

async function followMap() {
  let drawn = 0;
  while (!isOver) {
    if (shown !== drawn) {
      drawn = shown;
      try {
        const picture = await (await ask("map")).blob();
        const before = $("map").src;
        $("map").src = URL.createObjectURL(picture);
        if (before) URL.revokeObjectURL(before);
      } catch { /* the other loop says that the server does not answer */ }
    }
    await sleep(MAP_EVERY);
  }
}

// -------------------------------------------------------------------- record

function kindOfRecording() {
  return "MediaRecorder" in window ? KINDS.find((kind) => MediaRecorder.isTypeSupported(kind)) : undefined;
}

async function record() {
  const kind = kindOfRecording();
  const plain = kind.split(";")[0];
  $("record").disabled = true;
  try {
    await postJson("recording/begin", { kind: plain });
  } catch (error) {
    tell(explain(error));
    $("record").disabled = false;
    return;
  }
  const mine = new MediaRecorder(stream, { mimeType: kind, videoBitsPerSecond: BITS });
  const begun = performance.now();
  const job = { mine, size: 0, isDropped: false, problem: null, uploads: Promise.resolve() };
  recorder = job;
  mine.addEventListener("dataavailable", (event) => {
    job.uploads = job.uploads.then(() => upload(job, event.data, plain)).catch((error) => {
      job.problem ??= explain(error);
      if (mine.state !== "inactive") mine.stop();
    });
  });
  mine.addEventListener("stop", () => finish(job));
  mine.addEventListener("error", (event) => { job.problem ??= `The recording broke off (${event.error?.name}). Record again.`; });
  mine.start(PIECE_EVERY);
  Object.assign($("record"), { disabled: false, textContent: "stop" });
  $("record").classList.add("on");
  $("drop").hidden = false;
  $("cameras").disabled = true;
  while (mine.state === "recording") {
    const seconds = (performance.now() - begun) / 1000;
    $("recorded").textContent = `${seconds.toFixed(0)} of ${about.longest.toFixed(0)} s, ${(job.size / 1e6).toFixed(1)} MB`;
    if (seconds >= about.longest) mine.stop();
    await sleep(200);
  }
}

async function upload(job, data, kind) {
  for (let start = 0; start < data.size && !job.isDropped && !job.problem; start += about.most_piece_bytes) {
    const piece = data.slice(start, start + about.most_piece_bytes);
    await post(`recording?client=${client}&at=${job.size}`, piece, kind);
    job.size += piece.size;
  }
}

async function finish(job) {
  $("record").disabled = true;
  $("drop").hidden = true;
  $("recorded").textContent = "sending the rest";
  let uploads = null;
  while (uploads !== job.uploads) { uploads = job.uploads; await uploads; }
  try {
    if (job.isDropped || job.problem) {
      await postJson("recording/drop", {});
      $("recorded").textContent = "";
      if (job.problem) tell(job.problem);
    } else {
      const { path } = await (await postJson("recording/end", { bytes: job.size })).json();
      isOver = true;
      ending.abort();
      for (const track of stream.getTracks()) track.stop();
      $("instruction").textContent = "Recorded. The capture is being made: the terminal says how far it is. This page may be closed.";
      $("warnings").replaceChildren();
      $("recorded").textContent = path;
      $("recorded").dataset.path = path;
      return;
    }
  } catch (error) {
    tell(`The recording is not whole: ${explain(error)}`);
    $("recorded").textContent = "";
  }
  recorder = null;
  $("record").classList.remove("on");
  Object.assign($("record"), { disabled: false, textContent: "record" });
  $("cameras").disabled = false;
}

// --------------------------------------------------------------------- begin

function mirror() {
  document.body.classList.toggle("mirrored", $("mirror").checked);
}

async function begin() {
  try {
    about = await (await ask("about")).json();
  } catch (error) {
    tell(explain(error));
    return;
  }
  $("recorder").hidden = !about.records;
  $("driven").hidden = !about.drives;
  for (const step of about.steps) {
    const line = document.createElement("li");
    line.dataset.step = step.name;
    line.title = step.instruction;
    line.append(Object.assign(document.createElement("span"), { textContent: step.name }), Object.assign(document.createElement("progress"), { max: 1, value: 0 }));
    $("steps").append(line);
  }
  $("record").addEventListener("click", () => { if (recorder) recorder.mine.stop(); else record(); });
  $("drop").addEventListener("click", () => { recorder.isDropped = true; recorder.mine.stop(); });
  $("again").addEventListener("click", openCamera);
  $("cameras").addEventListener("change", openCamera);
  $("mirror").addEventListener("change", mirror);
  mirror();
  await openCamera();
  countFrames();
  for (let number = 0; number < about.at_once; number += 1) follow();
  followMap();
}

begin();
