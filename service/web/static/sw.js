// The service worker: keeps the frame of the screens and the last home page, so that a panel that loses the network shows the last state with
// its time. It answers nothing else: no data of the interface, no socket, nothing that changes something.

const SHELL = "abbe-shell-2";
const STATE = "abbe-state-2";
const HOME = "/";
const SCREEN = /^\/[a-z]*$/;
const FRAME = ["/static/page.css", "/static/status.js", "/static/stop.js", "/static/send.js", "/icon.svg"];
// Longest time until an answer begins; its body may take any time.
const HOME_MS = 5000;
const SCREEN_MS = 60_000;
const PART_MS = 1500;
const KEPT_MS = 12 * 3600_000;

addEventListener("install", (event) => {
  event.waitUntil(caches.open(SHELL).then((shell) => shell.addAll(FRAME)).then(() => skipWaiting()));
});

addEventListener("activate", (event) => {
  const old = (name) => name.startsWith("abbe-") && name !== SHELL && name !== STATE;
  const clean = caches.keys().then((names) => Promise.all(names.filter(old).map((name) => caches.delete(name))));
  event.waitUntil(clean.then(() => clients.claim()));
});

addEventListener("fetch", (event) => {
  const { request } = event;
  const url = new URL(request.url);
  if (url.origin !== location.origin) return;
  if (request.method !== "GET") {
    if (url.pathname === "/logout") event.waitUntil(caches.delete(STATE));
  } else if (request.mode === "navigate" ? SCREEN.test(url.pathname) : url.pathname === HOME) {
    event.respondWith(screen(event, url));
  } else if (url.pathname.startsWith("/static/") || url.pathname === "/icon.svg") {
    event.respondWith(part(event));
  }
});

async function begun(request, patienceMs) {
  const ending = new AbortController();
  const timer = setTimeout(() => ending.abort(), patienceMs);
  try {
    return await fetch(request, { signal: ending.signal });
  } finally {
    clearTimeout(timer);
  }
}

async function screen(event, url) {
  try {
    const answer = await begun(event.request, url.pathname === HOME ? HOME_MS : SCREEN_MS);
    // Who is logged out leaves nothing behind on a panel that others use.
    if (new URL(answer.url).pathname === "/login" || url.pathname === "/login") await caches.delete(STATE);
    else if (url.pathname === HOME && answer.ok && !answer.redirected) event.waitUntil(keep(answer.clone()));
    return answer;
  } catch (trouble) {
    const kept = event.request.mode === "navigate" ? await lastState() : undefined;
    if (kept) return kept;
    throw trouble;
  }
}

async function lastState() {
  const kept = await caches.match(HOME, { cacheName: STATE });
  const ageMs = Date.now() - Number(kept?.headers.get("X-Kept-Ms"));
  if (ageMs >= 0 && ageMs < KEPT_MS) return kept;
  await caches.delete(STATE);
  return undefined;
}

// Without the token of the session: whoever reads the storage of the browser can change nothing with it. Grey and with its banner, so that
// it never looks like the present state, even where no script runs.
async function keep(answer) {
  const now = new Date();
  const html = (await answer.text())
    .replace("<html ", `<html data-kept="${now.toISOString()}" `)
    .replace("<body ", '<body class="stale" ')
    .replace(/(<p id="lost"[^>]* data-at="([^"]*)") hidden>([^<]*)/, (_, tag, at, text) => `${tag}>${text} ${at.replace("{time}", now.toLocaleString("sv-SE"))}`)
    .replaceAll(/(data-csrf|name="csrf" value)="[0-9a-f]*"/g, '$1=""');
  const headers = { "Content-Type": "text/html; charset=utf-8", "X-Kept-Ms": String(now.getTime()) };
  const policy = answer.headers.get("Content-Security-Policy");
  if (policy) headers["Content-Security-Policy"] = policy;
  const state = await caches.open(STATE);
  await state.put(HOME, new Response(html, { headers }));
}

async function part(event) {
  const kept = await caches.match(event.request, { cacheName: SHELL });
  try {
    const answer = await (kept ? begun(event.request, PART_MS) : fetch(event.request));
    if (answer.ok) {
      const copy = answer.clone();
      event.waitUntil(caches.open(SHELL).then((shell) => shell.put(event.request, copy)));
    }
    return answer;
  } catch (trouble) {
    if (kept) return kept;
    throw trouble;
  }
}
