// Shows on every screen whether the service answers, and the status bar with Stop. Refreshes the home page: progress every 2 s from the JSON,
// everything else from the server when the revision changes. Other screens are not replaced, since a person may be reading or filling in a
// form.

import { answered } from "./stop.js";

const PERIOD_MS = 2000;
const PATIENCE_MS = 5000;
const LOGOUT_MS = 60000;  // a busy computer takes long to log a person out

const banner = document.getElementById("lost");
const words = JSON.parse(document.body.dataset.words);
// Whether a person has used the page since the last refresh: only that extends the session.
let touched = false;
for (const kind of ["pointerdown", "keydown", "wheel"]) addEventListener(kind, () => { touched = true; }, { passive: true });
let revision = document.getElementById("content").dataset.revision;
const refreshes = revision !== undefined;

function setText(id, text) {
  const element = document.getElementById(id);
  if (element && element.textContent !== text) element.textContent = text;
}

function filled(key, name, value) {
  return words[key].replace(`{${name}}`, value);
}

function span(seconds) {
  const s = Math.abs(seconds);
  if (s < 90) return filled("span.s", "n", Math.round(s));
  if (s < 5400) return filled("span.min", "n", Math.round(s / 60));
  if (s < 129600) return filled("span.h", "n", Math.round(s / 3600));
  return filled("span.days", "n", Math.round(s / 86400));
}

function left(seconds) {
  return seconds === null ? words["job.unknown"] : filled("job.left", "span", span(seconds));
}

function showStatus(status) {
  const now = Date.parse(status.now_utc);
  for (const element of document.querySelectorAll("[data-until]")) {
    const seconds = (Date.parse(element.dataset.until) - now) / 1000;
    const text = seconds > 0 ? filled("due.in", "span", span(seconds)) : words["due.now"];
    if (element.textContent !== text) element.textContent = text;
  }
  // Only on screens that also refresh the times: an age must not grow beside a stale time.
  for (const element of refreshes ? document.querySelectorAll("[data-since]") : []) {
    const text = filled("ago", "span", span((now - Date.parse(element.dataset.since)) / 1000));
    if (element.textContent !== text) element.textContent = text;
  }
  setText("waiting", String(status.mqtt.waiting));
  if (!status.job) return;
  const bar = document.getElementById("job-bar");
  if (bar && status.job.total > 0) {
    bar.max = status.job.total;
    bar.value = status.job.done;
  }
  if (status.job.stage) setText("job-stage", status.job.stage);
  setText("job-message", status.job.message);
  setText("job-left", left(status.job.eta_s));
}

// The bar comes from the server again when anything in it but the time left has changed.
let shownBar = "";

async function showBar(status) {
  setText("strip-left", status.job ? left(status.job.eta_s) : "");
  const shelved = status.alarms.map((one) => Date.parse(one.shelved_until_utc ?? "") > Date.parse(status.now_utc));
  const next = JSON.stringify([status.revision, status.job?.state, status.job?.stage, status.job?.step, status.devices.map((one) => one.state), shelved]);
  if (next === shownBar) return;
  const answer = await ask("/strip", false);
  if (!answer.ok) return;
  const page = new DOMParser().parseFromString(await answer.text(), "text/html");
  const kept = document.getElementById("stop-answer");
  document.getElementById("machine-bar").replaceWith(page.getElementById("machine-bar"));
  if (kept) document.getElementById("stop-answer")?.replaceWith(kept);
  shownBar = next;
}

document.addEventListener("click", (event) => {
  const point = event.target.closest("[data-href]");
  if (point) location.assign(point.dataset.href);
});

let asking = new AbortController();
let quietUntil = 0;

function ask(path, active) {
  if (performance.now() < quietUntil) return Promise.reject(new Error("logged out"));
  const one = asking = new AbortController();
  setTimeout(() => one.abort(), PATIENCE_MS);
  return fetch(path, { headers: { "X-Abbe-Active": active ? "1" : "0" }, signal: one.signal });
}

// Whoever logs out asks nothing more: the answer would be a refusal. A page that is still there after a while is shown as stale.
document.getElementById("logout")?.form.addEventListener("submit", () => {
  quietUntil = performance.now() + LOGOUT_MS;
  asking.abort();
});

async function replaceContent(next) {
  const answer = await ask("/", false);
  if (!answer.ok) throw new Error(`status ${answer.status}`);
  const page = new DOMParser().parseFromString(await answer.text(), "text/html");
  document.getElementById("content").replaceWith(page.getElementById("content"));
  revision = next;
}

const LOST = banner.dataset.text ?? banner.textContent;
// Set by the service worker: this page comes from its store, since the service could not be reached.
const kept = document.documentElement.dataset.kept;
let seen = new Date(kept ?? Date.now());

function connected(yes, silent = false) {
  banner.hidden = yes;
  if (!yes) banner.textContent = `${silent ? words["lost.core"] : LOST} ${filled("lost.at", "time", seen.toLocaleString("sv-SE"))}`;
  document.body.classList.toggle("stale", !yes);
}

// The log-in has run out: home and the running measurement stay in grey until somebody logs in, and their Stop still works. Every other
// screen is left, so that nobody reads it at an unattended panel.
const stays = Boolean(kept) || ["/", "/live"].includes(location.pathname);
let out = false;

function loggedOut() {
  out = true;
  if (banner.querySelector("a")) return;  // a banner that is built again is read aloud again
  connected(false);
  const link = document.createElement("a");
  link.href = "/login";
  link.textContent = words.login;
  banner.replaceChildren(`${words["strip.out"]} `, link);
}

async function refresh() {
  const quiet = quietUntil - performance.now();
  if (quiet > 0) {
    if (quiet < LOGOUT_MS - PATIENCE_MS) connected(false);
    setTimeout(refresh, PERIOD_MS);
    return;
  }
  let silent = false;
  try {
    const active = touched;
    touched = false;
    const answer = await ask("/api/v1/status", active);
    if (answer.status === 401) {
      if (stays && (await ask("/api/v1/stop", false)).ok) loggedOut();
      else location.assign("/login");
      setTimeout(refresh, PERIOD_MS);
      return;
    }
    if (out && answer.ok) { location.reload(); return; }
    if (!answer.ok) {
      silent = answer.status === 503 && (await answer.json()).code === "SRV-002";
      throw new Error(`status ${answer.status}`);
    }
    const status = await answer.json();
    if (kept && performance.now() > answered.until) { location.reload(); return; }
    if (kept) throw new Error("the answer to Stop is being read");
    seen = new Date();
    // The screen of an unavailable core has no revision: reload it, now that the core answers.
    if (revision === "") { location.reload(); return; }
    if (revision !== undefined && status.revision !== revision) await replaceContent(status.revision);
    showStatus(status);
    await showBar(status);
    connected(true);
  } catch {
    // Whatever the reason, the page is stale from now on.
    if (performance.now() >= quietUntil) connected(false, silent);
  }
  setTimeout(refresh, PERIOD_MS);
}

if (kept) connected(false);
navigator.serviceWorker?.register("/sw.js").catch(() => {});  // refused without TLS or with an unknown certificate: then nothing is kept
setTimeout(refresh, PERIOD_MS);
document.documentElement.dataset.ready = "yes";
