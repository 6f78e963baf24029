// The service worker: keeps the frame of the screens and the last home page, so that a panel that loses the network shows the last state with
// its time. It answers nothing else: no data of the interface, no socket, nothing that changes something.

const SHELL = "abbe-shell-1";
const STATE = "abbe-state-1";
const HOME = "/";
const FRAME = ["/static/page.css", "/static/status.js", "/static/send.js", "/icon.svg"];
const PATIENCE_MS = 5000;

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
  } else if (request.mode === "navigate" || url.pathname === HOME) {
    event.respondWith(screen(event, url));
  } else if (url.pathname.startsWith("/static/") || url.pathname === "/icon.svg") {
    event.respondWith(part(event));
  }
});

async function screen(event, url) {
  try {
    const answer = await fetch(event.request, { signal: AbortSignal.timeout(PATIENCE_MS * (url.pathname === HOME ? 1 : 12)) });
    // Who is logged out leaves nothing behind on a panel that others use.
    if (new URL(answer.url).pathname === "/login" || url.pathname === "/login") await caches.delete(STATE);
    else if (url.pathname === HOME && answer.ok && !answer.redirected) event.waitUntil(keep(answer.clone()));
    return answer;
  } catch (trouble) {
    const kept = event.request.mode === "navigate" ? await caches.match(HOME, { cacheName: STATE }) : undefined;
    if (kept) return kept;
    throw trouble;
  }
}

// Without the token of the session: whoever reads the storage of the browser can change nothing with it.
async function keep(answer) {
  const html = (await answer.text())
    .replace("<html ", `<html data-kept="${new Date().toISOString()}" `)
    .replaceAll(/(data-csrf|name="csrf" value)="[0-9a-f]*"/g, '$1=""');
  const headers = { "Content-Type": "text/html; charset=utf-8" };
  const policy = answer.headers.get("Content-Security-Policy");
  if (policy) headers["Content-Security-Policy"] = policy;
  const state = await caches.open(STATE);
  await state.put(HOME, new Response(html, { headers }));
}

async function part(event) {
  try {
    const answer = await fetch(event.request);
    if (answer.ok) {
      const copy = answer.clone();
      event.waitUntil(caches.open(SHELL).then((shell) => shell.put(event.request, copy)));
    }
    return answer;
  } catch (trouble) {
    const kept = await caches.match(event.request, { cacheName: SHELL });
    if (kept) return kept;
    throw trouble;
  }
}
