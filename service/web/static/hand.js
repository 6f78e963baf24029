// The button "Done" of a manual step confirms exactly the prompt beside it.

const READ_MS = 1000;
let seen = "";
let readable = 0;
let timer = 0;

function shown() {
  return document.querySelector("#by-hand button");
}

function nameOf(button) {
  return `${button.dataset.job}/${button.dataset.prompt}`;
}

// The button stays disabled until a new prompt has been shown for a second, so that a late click on the previous prompt does not confirm the
// new one. The second counts per prompt, not per button: the page may replace the button meanwhile.
function look() {
  const button = shown();
  if (!button) return;
  const name = nameOf(button);
  const now = performance.now();
  if (name !== seen) {
    seen = name;
    readable = now + READ_MS;
  }
  if (now >= readable) return;
  button.disabled = true;
  clearTimeout(timer);
  timer = setTimeout(() => {
    const there = shown();
    if (there && nameOf(there) === name) there.disabled = false;
  }, readable - now);
}

new MutationObserver(look).observe(document.body, { subtree: true, childList: true, attributes: true, attributeFilter: ["data-prompt", "data-job"] });
look();

async function done(button) {
  const { job, prompt, csrf } = button.dataset;
  const name = nameOf(button);
  const card = button.closest("section");
  const alert = card.querySelector("#by-hand-alert");
  button.disabled = true;
  alert.textContent = "";
  const headers = { "X-CSRF-Token": csrf };
  const answer = await fetch(`/api/v1/jobs/${job}/prompts/${prompt}/done`, { method: "POST", headers }).catch((trouble) => trouble);
  const problem = !answer.ok && answer.json ? await answer.json().catch(() => ({})) : {};
  // The card may have been replaced, or show another prompt, meanwhile.
  if (!button.isConnected || nameOf(button) !== name) return;
  button.disabled = false;
  if (answer.ok) card.hidden = true;
  else alert.textContent = problem.detail || String(answer.statusText || answer);
}

// Listen on the document, because the home page replaces its content.
document.addEventListener("click", (event) => {
  const button = event.target.closest("button[data-prompt]");
  if (button) done(button);
});
