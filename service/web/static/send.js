// Sends forms that change something, with the token of the session in a header: a page of another site can neither read nor set it.

async function send(form) {
  const fields = new URLSearchParams(new FormData(form));
  const token = fields.get("csrf") ?? "";
  fields.delete("csrf");
  const answer = await fetch(form.action, { method: "POST", body: fields, headers: { "X-CSRF-Token": token } });
  if (answer.ok) {
    location.assign(answer.url);
    return "";
  }
  const problem = await answer.json().catch(() => ({}));
  return problem.detail || `${answer.status} ${answer.statusText}`;
}

for (const form of document.querySelectorAll("form[data-send]")) {
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const button = form.querySelector("button");
    button.disabled = true;
    const text = await send(form).catch((trouble) => String(trouble));
    button.disabled = false;
    form.querySelector("[role=alert]").textContent = text;
  });
}
