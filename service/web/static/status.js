// Refreshes the page: what moves every 2 s from the JSON, everything else from the server when the revision changes.

const PERIOD_MS = 2000;
const PATIENCE_MS = 5000;

const banner = document.getElementById("lost");
let revision = document.getElementById("content").dataset.revision;

function setText(id, text) {
  const element = document.getElementById(id);
  if (element && element.textContent !== text) element.textContent = text;
}

function left(seconds) {
  if (seconds === null) return "time left not known yet";
  return seconds < 90 ? `${Math.round(seconds)} s left` : `${Math.round(seconds / 60)} min left`;
}

function showMoment(status) {
  for (const [index, due] of status.next_due.entries()) setText(`due-${index}`, due.words);
  setText("waiting", String(status.mqtt.waiting));
  if (!status.job) return;
  const bar = document.getElementById("job-bar");
  if (bar && status.job.total > 0) {
    bar.max = status.job.total;
    bar.value = status.job.done;
  }
  setText("job-stage", status.job.stage || "starting");
  setText("job-message", status.job.message);
  setText("job-left", left(status.job.eta_s));
}

async function replaceContent(next) {
  const answer = await fetch("/", { signal: AbortSignal.timeout(PATIENCE_MS) });
  if (!answer.ok) throw new Error(`status ${answer.status}`);
  const page = new DOMParser().parseFromString(await answer.text(), "text/html");
  document.getElementById("content").replaceWith(page.getElementById("content"));
  revision = next;
}

function connected(yes) {
  banner.hidden = yes;
  document.body.classList.toggle("stale", !yes);
}

async function refresh() {
  try {
    const answer = await fetch("/api/v1/status", { signal: AbortSignal.timeout(PATIENCE_MS) });
    if (answer.status === 401) location.assign("/login");
    if (!answer.ok) throw new Error(`status ${answer.status}`);
    const status = await answer.json();
    if (status.revision !== revision) await replaceContent(status.revision);
    showMoment(status);
    connected(true);
  } catch {
    // Whatever the reason, what stands on the page is from now on old.
    connected(false);
  }
  setTimeout(refresh, PERIOD_MS);
}

setTimeout(refresh, PERIOD_MS);
document.documentElement.dataset.ready = "yes";
