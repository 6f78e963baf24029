// The report of a long run takes the service seconds: it comes after the curve stands.

const PATIENCE_MS = 15_000;
const LONGEST_MS = 180_000;
const place = document.getElementById("run-report");

async function report() {
  const answer = await fetch(place.dataset.from, { signal: AbortSignal.timeout(LONGEST_MS) });
  if (!answer.ok) throw new Error(`status ${answer.status}`);
  const page = new DOMParser().parseFromString(await answer.text(), "text/html");
  return page.getElementById("run-report").childNodes;
}

async function fill() {
  try {
    place.replaceChildren(...(await report()));
  } catch {
    for (const text of place.children) text.hidden = !text.hidden;
  }
  place.removeAttribute("aria-busy");
}

function wait(begun) {
  if (document.querySelector("[data-run] canvas") || performance.now() - begun > PATIENCE_MS) fill();
  else setTimeout(wait, 100, begun);
}

if (place?.dataset.from) wait(performance.now());
