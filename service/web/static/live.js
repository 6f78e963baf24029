// The live run: two WebSockets (status and samples), two traces, and the buttons that control the run.

import { Machine } from "./machine.js";
import { Traces, framesOf } from "./traces.js";

const AGAIN_MS = 1000;
const SILENT_MS = 6000;
const OLD_MS = 2000;

const root = document.getElementById("live");
const words = JSON.parse(root.dataset.words);
const spans = JSON.parse(document.body.dataset.words);
const job = root.dataset.job ?? "";
// A campaign that the service started itself has no number: the screen shows it without buttons.
const shows = "job" in root.dataset;
const lost = document.getElementById("live-lost");
const find = (id) => document.getElementById(id);
// The reader's unit for deviations, and its size in µm; a µin is finer than the shown tenth of a µm.
const unit = { sign: root.dataset.unit, size: Number(root.dataset.size) };
const decimals = unit.size < 0.1 ? 0 : 1;

function setText(id, text) {
  const element = find(id);
  if (element && element.textContent !== text) element.textContent = text;
}

function span(seconds) {
  const [key, n] = seconds < 90 ? ["span.s", seconds] : seconds < 5400 ? ["span.min", seconds / 60] : ["span.h", seconds / 3600];
  return spans[key].replace("{n}", Math.round(n));
}

// ---- connections: reconnect forever; a silent connection counts as lost -------------------------------------------------------------

const connections = new Map();

function keepOpen(path, patienceMs, onMessage) {
  const state = { at: performance.now(), gone: performance.now(), open: false };
  connections.set(path, state);
  const connect = () => {
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${path}`);
    socket.binaryType = "arraybuffer";
    const watch = setInterval(() => {
      if (performance.now() - Math.max(state.at, begun) > patienceMs) socket.close();
    }, 1000);
    const begun = performance.now();
    socket.onopen = () => { state.open = true; state.at = performance.now(); };
    socket.onmessage = (event) => { state.at = performance.now(); onMessage(event.data); };
    socket.onclose = () => {
      clearInterval(watch);
      // A refused attempt does not reset the time: repeated refusals count as lost.
      if (state.open) state.gone = performance.now();
      state.open = false;
      setTimeout(connect, AGAIN_MS);
    };
  };
  connect();
}

// ---- status ------------------------------------------------------------------------------------------------------------------------

let now = null;
let traces = null;
let machine = null;
let leftAt = 0;

function showState(state) {
  setText("live-state", words[`measuring.${state}`] ?? state);
  const pause = document.querySelector("[data-how=pause], [data-how=resume]");
  if (!pause) return;
  const held = ["paused", "pausing", "suspended"].includes(state);
  pause.dataset.how = held ? "resume" : "pause";
  const text = held ? words["live.resume"] : words["live.pause"];
  if (pause.textContent !== text) pause.textContent = text;
}

// The core reports progress after each step; within a path, a step of minutes, the samples show the progress.
function showProgress() {
  if (!now || now === "over" || !(now.total > 0)) return;
  const bar = find("live-bar");
  const inPath = traces?.running ? traces.count / traces.path.rate_hz : 0;
  bar.max = now.total;
  bar.value = Math.min(now.total, now.done + inPath);
}

// The prompt for a person. The button has its number, so an answer belongs to the prompt that was visible.
function showPrompt(number, text) {
  const card = find("by-hand");
  const button = card.querySelector("button");
  card.hidden = !number;
  if (!number || card.dataset.prompt === String(number)) return;
  card.dataset.prompt = number;
  setText("by-hand-text", text);
  setText("by-hand-alert", "");
  if (button) button.dataset.prompt = number;
}

async function showEnd() {
  document.body.classList.add("over");
  find("steer")?.remove();
  find("by-hand")?.remove();
  if (find("ask-stop")?.open) find("ask-stop").close();
  const answer = job ? await fetch(`/api/v1/jobs/${job}`, { headers: { "X-Abbe-Active": "0" } }).catch(() => null) : null;
  const ended = answer?.ok ? await answer.json() : null;
  setText("live-outcome", words["live.ended"].replace("{state}", ended ? words[`slot.${ended.state}`] ?? ended.state : "–"));
  setText("live-text", ended?.text ?? "");
  for (const [id, screen, number] of [
    ["live-check", "check", ended?.verification],
    ["live-made", "proposal", ended?.proposal],
    ["live-alarm", "alarm", ended?.alarm],
  ]) {
    find(id).hidden = !number;
    find(id).querySelector("a").href = `/${screen}?id=${number}`;
  }
  find("live-again").hidden = ended?.kind !== "campaign" || !["done: stopped", "done: failed"].includes(ended.state) || Boolean(ended.alarm);
  setText("live-state", words["measuring.ended"]);
  find("live-over").hidden = false;
}

function onStatus(text) {
  const event = JSON.parse(text);
  if (!shows) {
    if (event.job) location.reload();
    return;
  }
  if (now !== "over" && event.job?.id !== job) {
    now = "over";
    showEnd();
    return;
  }
  if (now === "over") return;
  if (event.job.eta_s !== now?.eta_s) leftAt = performance.now();
  now = event.job;
  showState(now.state);
  showProgress();
  showLeft();
  showPrompt(now.prompt, now.ask);
  if (now.message) setText("live-message", now.message);
  if (now.steps) setText("live-step", words["live.of"].replace("{n}", now.step).replace("{m}", now.steps));
  setText("live-points", String(now.points));
}

// The core tells the time left after each step; in between it runs down here.
function showLeft() {
  if (!now || now === "over") return;
  const left = now.eta_s === null ? null : Math.max(0, now.eta_s - (now.state === "running" ? (performance.now() - leftAt) / 1000 : 0));
  setText("live-left", left === null ? spans["job.unknown"] : spans["job.left"].replace("{span}", span(left)));
}

// The last check that passed, along the same path, in grey below the trace.
async function showBefore(path) {
  const answer = await fetch(`/live/before?${new URLSearchParams({ run: path.run })}`, { headers: { "X-Abbe-Active": "0" } }).catch(() => null);
  const before = answer?.ok ? await answer.json() : null;
  find("live-before").hidden = !before?.values.length;
  if (!before?.values.length || traces.path !== path) return;
  setText("live-before", words["live.before"].replace("{n}", before.check));
  traces.showBefore(before.values);
}

keepOpen("/api/v1/live", SILENT_MS, onStatus);

// ---- samples of the path ----------------------------------------------------------------------------------------------------------

let asked = false;
let newest = 0;
let lastFrame = 0;

function paint() {
  asked = false;
  traces.draw();
  showProgress();
  setText("live-samples", String(traces.count));
  if (Number.isFinite(traces.last)) {
    setText("live-value", traces.last.toFixed(decimals));
    setText("live-range", `${traces.least.toFixed(decimals)} … ${traces.most.toFixed(decimals)}`);
    setText("polar-scale", words["live.share_here"].replace("{n}", traces.scale).replace("{unit}", unit.sign));
    setText("strip-scale", `20 s, ±${traces.scale} ${unit.sign}`);
  }
  dispatchEvent(new CustomEvent("live-drawn", { detail: { arrivedMs: newest, count: traces.count } }));
}

function showMachine(reading) {
  machine.show(reading);
  if (traces.running || !machine.hasLaser) return;
  find("live-pair").classList.add("single");
  find("live-pair").classList.remove("old");
  setText("live-note", "");
  setText("live-run", words["live.laser"]);
  traces.fit();
  machine.draw(root.dataset.mmSign);
}

function onSamples(data) {
  if (typeof data === "string") {
    const path = JSON.parse(data);
    if (path.machine !== undefined) {
      showMachine(path.machine);
      return;
    }
    machine.forget();
    setText("live-note", path.number ? "" : words["live.no_path"]);
    if (path.number && path.number !== traces.path.number) {
      traces.begin(path);
      setText("live-run", path.run);
      lastFrame = performance.now();
      find("live-pair").classList.remove("single");
      setText("strip-name", words["live.strip"]);
      showBefore(path);
    }
    traces.running = path.number > 0;
    find("live-pair").classList.toggle("old", !traces.running);
    return;
  }
  for (const frame of framesOf(data)) {
    if (frame.path !== traces.path.number) continue;
    traces.take(frame.first, frame.values);
    newest = frame.arrivedMs;
    lastFrame = performance.now();
  }
  if (!asked) {
    asked = true;
    requestAnimationFrame(paint);
  }
}

if (shows) {
  traces = new Traces(find("strip"), find("polar"), unit);
  machine = new Machine(root, words);
  keepOpen("/api/v1/live/samples", Infinity, onSamples);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { traces.drawStrip(); traces.drawPolar(true); });
}

// ---- once a second: check for stale data -------------------------------------------------------------------------------------------

setInterval(() => {
  const old = [...connections.values()].some((state) => !state.open && performance.now() - state.gone > 2 * AGAIN_MS);
  lost.hidden = !old;
  if (!shows) return;
  if (now !== "over") setText("live-elapsed", span(Number(root.dataset.elapsed) + performance.now() / 1000));
  showLeft();
  machine.hideOld();
  const stale = old || (traces.running ? performance.now() - lastFrame > OLD_MS : !machine.hasLaser);
  find("live-pair").classList.toggle("old", stale);
  if (traces.running) setText("live-note", stale ? words["live.old"] : "");
}, 1000);

// ---- steering ----------------------------------------------------------------------------------------------------------------------

async function steer(how) {
  const headers = { "X-CSRF-Token": root.dataset.csrf };
  const answer = await fetch(`/api/v1/jobs/${job}/${how}`, { method: "POST", headers }).catch((trouble) => trouble);
  if (answer.ok) {
    setText("steer-alert", "");
    showState((await answer.json()).state);
    return;
  }
  const problem = answer.json ? await answer.json().catch(() => ({})) : {};
  setText("steer-alert", problem.detail || words["live.gone"]);
}

const dialog = find("ask-stop");
if (dialog) {
  for (const button of document.querySelectorAll("#steer button")) button.addEventListener("click", () => steer(button.dataset.how));
  dialog.addEventListener("close", () => { if (dialog.returnValue === "stop") steer("stop"); });
  addEventListener("keydown", (event) => {
    if (dialog.open || now === "over" || event.altKey || event.ctrlKey || event.metaKey) return;
    if (event.key === "Escape") {
      event.preventDefault();
      dialog.returnValue = "";
      dialog.showModal();
    } else if (event.key === " " && !event.target.closest("button, a, input, select, textarea, summary")) {
      event.preventDefault();
      if (!event.repeat) steer(document.querySelector("[data-how=pause], [data-how=resume]").dataset.how);
    }
  });
}
