// Stop stays in its place and works with a session that has run out; the answer stands beside it.

const PATIENCE_MS = 5000;
const words = JSON.parse(document.body.dataset.words);

// Until then a kept page is not replaced, so that the answer can be read.
export const answered = { until: 0 };

// A kept page has no token: it asks for that of the session first, which may have run out. Null: the service cannot be reached.
async function ask(button) {
  if (!button.dataset.csrf) {
    const token = await fetch("/api/v1/stop", { headers: { "X-Abbe-Active": "1" }, signal: AbortSignal.timeout(PATIENCE_MS) });
    if (!token.ok) return token;
    button.dataset.csrf = (await token.json()).csrf_token;
  }
  const headers = { "X-CSRF-Token": button.dataset.csrf };
  return fetch("/api/v1/stop", { method: "POST", headers, signal: AbortSignal.timeout(PATIENCE_MS) });
}

document.addEventListener("click", async (event) => {
  const button = event.target.closest("#stop");
  if (!button) return;
  answered.until = Infinity;
  const answer = await ask(button).catch(() => null);
  answered.until = performance.now() + PATIENCE_MS;
  const key = answer === null ? "strip.unreached" : answer.ok ? "strip.stopped" : answer.status === 409 ? "strip.nothing" : "strip.failed";
  document.getElementById("stop-answer").textContent = words[key];
});
