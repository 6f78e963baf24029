// Orders a rollback or a push of a table after a second confirmation, and follows the job to its end. The key comes with the page, so a
// second click or a repeated request places no second order.

const form = document.getElementById("order");
const dialog = document.getElementById("ask-order");
const reason = form?.elements.reason;
const POLL_MS = 1000;

function showError(text) {
  form.querySelector("[role=alert]").textContent = text;
}

async function follow(place) {
  const shown = document.getElementById("order-job");
  const words = JSON.parse(shown.dataset.words);
  shown.hidden = false;
  for (;;) {
    const answer = await fetch(place, { headers: { "X-Abbe-Active": "0" } }).catch(() => null);
    if (answer?.ok) {
      const job = await answer.json();
      if (job.ended_utc) {
        const word = job.state.replace(/^done: /, "");
        document.getElementById("order-state").textContent = words[word] ?? word;
        document.getElementById("order-text").textContent = job.text;
        document.getElementById("order-over").hidden = false;
        return;
      }
    } else if (answer) {
      showError(`${answer.status} ${answer.statusText}`);
      document.getElementById("order-over").hidden = false;
      return;
    }
    await new Promise((resolve) => setTimeout(resolve, POLL_MS));
  }
}

async function order() {
  const { to, body, key, csrf } = form.dataset;
  const answer = await fetch(to, {
    method: "POST",
    body: JSON.stringify(reason ? { ...JSON.parse(body), reason: reason.value.trim() } : JSON.parse(body)),
    headers: { "Content-Type": "application/json", "X-CSRF-Token": csrf, "Idempotency-Key": key },
  });
  if (answer.ok) {
    form.hidden = true;
    await follow(answer.headers.get("Location"));
    return;
  }
  const problem = await answer.json().catch(() => ({}));
  showError(problem.detail || `${answer.status} ${answer.statusText}`);
}

form?.addEventListener("submit", (event) => {
  event.preventDefault();
  if (reason && !reason.value.trim()) {
    reason.focus();
    return;
  }
  if (reason) document.getElementById("ask-reason").textContent = reason.value.trim();
  dialog.returnValue = "";
  dialog.showModal();
});

if (dialog && new URLSearchParams(location.search).get("push") === "ask") {
  history.replaceState(null, "", location.href.replace(/&push=ask/, ""));  // asked once, not again when the page is loaded anew
  dialog.returnValue = "";
  dialog.showModal();
}

dialog?.addEventListener("close", async () => {
  if (dialog.returnValue !== "order") return;
  const button = form.querySelector("button");
  button.disabled = true;
  showError("");
  await order().catch((trouble) => showError(String(trouble)));
  button.disabled = false;
});
