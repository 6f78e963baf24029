// Starts the recipe of the dry run. The key comes with the page, so a second click or a repeated request starts no second job.

const form = document.getElementById("start");

async function start() {
  const { recipe, rate, alarm, resume, key, csrf } = form.dataset;
  const answer = await fetch("/api/v1/jobs", {
    method: "POST",
    body: JSON.stringify({ recipe, rate_hz: Number(rate), alarm: Number(alarm), resume }),
    headers: { "Content-Type": "application/json", "X-CSRF-Token": csrf, "Idempotency-Key": key },
  });
  if (answer.ok) {
    location.assign("/live");
    return "";
  }
  const problem = await answer.json().catch(() => ({}));
  return problem.detail || `${answer.status} ${answer.statusText}`;
}

form?.addEventListener("submit", async (event) => {
  event.preventDefault();
  const button = form.querySelector("button");
  button.disabled = true;
  const text = await start().catch((trouble) => String(trouble));
  button.disabled = false;
  form.querySelector("[role=alert]").textContent = text;
});
