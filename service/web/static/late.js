// The report of a long run takes the service seconds: it comes after the curve stands.

const PATIENCE_MS = 15_000;
const place = document.getElementById("run-report");

async function fill() {
  const answer = await fetch(place.dataset.from).catch(() => null);
  if (!answer?.ok) return;
  const page = new DOMParser().parseFromString(await answer.text(), "text/html");
  place.replaceChildren(...page.getElementById("run-report").childNodes);
  place.removeAttribute("aria-busy");
}

function wait(begun) {
  if (document.querySelector("[data-run] canvas") || performance.now() - begun > PATIENCE_MS) fill();
  else setTimeout(wait, 100, begun);
}

if (place?.dataset.from) wait(performance.now());
