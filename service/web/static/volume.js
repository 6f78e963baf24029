// The volume map: rotation, zoom and selection by mouse, touch and keyboard. Without WebGL2 the slice and the table show the same data.

import { painter, rotation } from "/static/volume_gl.js";
import { moved, prepared, shape } from "/static/volume_shape.js";

const PLANE_AXIS = { XY: 2, XZ: 1, YZ: 0 };
const HOME = { yaw: -0.6, pitch: 0.45, zoom: 1.15 };
const scene = document.getElementById("scene");
const note = document.getElementById("no-scene");

function rgba(name, alpha = 1) {
  const text = getComputedStyle(scene).getPropertyValue(name).trim();
  return [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16) / 255).concat(alpha);
}

function styleNow(top) {
  const steps = [1, 2, 3, 4, 5].map((i) => rgba(`--seq${i}`));
  return { top, steps, grey: rgba("--frame", 0.6), nominal: rgba("--frame", 0.35), ink: rgba("--ink") };
}

// The reader's units with sign and size: numbers arrive in mm and µm and are converted once.
const given = scene?.dataset ?? {};
const unit = { place: given.place, mm: Number(given.placeSize), error: given.error, um: Number(given.errorSize) };

// Rounds to two significant digits of U, as everywhere in Abbe: with U = 470, to tens.
function rounded(value, expanded) {
  const digits = expanded > 0 ? Math.min(6, 1 - Math.floor(Math.log10(Number(expanded.toPrecision(2))))) : 3;
  const text = digits < 0 ? String(Math.round(value / 10 ** -digits) * 10 ** -digits) : value.toFixed(digits);
  return text.replace(/^-(?=.*[1-9])/, "−").replace(/^-/, "");
}

function sentence(map, k, words) {
  const [d, u] = [map.deviation[k], map.expanded[k]];
  const parts = { x: d[0], y: d[1], z: d[2] };
  let text = words[map.significant[k] ? "significant" : "notSignificant"].replace("{place}", map.at[k].join(", "));
  Object.entries(parts).forEach(([name, value], i) => { text = text.replace(`{${name}}`, `${rounded(value, u[i])} ± ${rounded(u[i], u[i])}`); });
  text = text.replace("{length}", rounded(map.length[k], u[3])).replace("{u}", rounded(u[3], u[3]));
  return text.replaceAll("{unit}", unit.error).replaceAll("{place_unit}", unit.place);
}

function start(map, paint) {
  const canvas = scene.querySelector("canvas");
  const labels = scene.querySelector(".stage svg");
  const field = (name) => scene.querySelector(`[name="${name}"]`);
  const words = JSON.parse(document.getElementById("node").dataset.words);
  const base = Number(scene.dataset.factor);
  const state = { ...HOME, node: Math.floor(map.places.length / 2) };
  let colours = styleNow(Number(scene.dataset.top));
  let stale = true;
  let waiting = false;

  function view() {
    const factor = base * 10 ** (Number(field("factor").value) / 10);
    const plane = field("cut").value;
    const level = Number(field("level").value);
    const axis = PLANE_AXIS[plane];
    field("factor-text").textContent = `${Number(factor.toPrecision(2))} ×`;
    field("level-text").textContent = plane ? `${"XYZ"[axis]} ${map.axes[axis][level]} ${unit.place}` : "";
    field("level").disabled = !plane;
    return { factor, cut: plane ? { axis, level } : null, grid: field("grid").checked, arrows: field("arrows").checked, node: state.node };
  }

  function onScreen(place) {
    const rows = rotation(state.yaw, state.pitch);
    const side = Math.min(canvas.clientWidth, canvas.clientHeight);
    const [x, y] = rows.map((row) => row[0] * place[0] + row[1] * place[1] + row[2] * place[2]);
    return [canvas.clientWidth / 2 + (x * state.zoom * side) / 2, canvas.clientHeight / 2 - (y * state.zoom * side) / 2];
  }

  function name() {
    labels.replaceChildren();
    ["X", "Y", "Z"].forEach((axis, i) => {
      const place = map.box.map((half, k) => (k === i ? half + 0.09 : i === 2 && k === 1 ? half : -half)); // Z stands at the left edge
      const text = document.createElementNS("http://www.w3.org/2000/svg", "text");
      const [x, y] = onScreen(place);
      text.setAttribute("x", x.toFixed(1));
      text.setAttribute("y", y.toFixed(1));
      text.textContent = `${axis} ${map.axes[i][0]} … ${map.axes[i][map.n - 1]} ${unit.place}`;
      labels.append(text);
    });
  }

  function draw() {
    waiting = false;
    const ratio = Math.min(2, window.devicePixelRatio || 1);
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (stale) paint.fill(...shape(map, view(), colours));
    stale = false;
    paint.draw(rotation(state.yaw, state.pitch), state.zoom);
    name();
    const html = document.documentElement;
    html.dataset.plotted ??= String(Math.round(performance.now()));
    html.dataset.view = [state.yaw, state.pitch, state.zoom].map((v) => v.toFixed(3)).join(" ");
  }

  function soon(changed) {
    stale ||= changed;
    if (!waiting) requestAnimationFrame(draw);
    waiting = true;
  }

  function turn(right, up) {
    state.yaw += right;
    state.pitch = Math.max(-1.5, Math.min(1.5, state.pitch + up));
    soon(false);
  }

  function zoom(by) {
    state.zoom = Math.max(0.4, Math.min(12, state.zoom * by));
    soon(false);
  }

  function home() {
    Object.assign(state, HOME);
    soon(false);
  }

  function choose(k) {
    state.node = k;
    const at = [Math.floor(k / map.n ** 2), Math.floor(k / map.n) % map.n, k % map.n];
    "XYZ".split("").forEach((axis, i) => { field(`node-${axis}`).value = String(at[i]); });
    document.getElementById("node").textContent = sentence(map, k, words);
    soon(true);
  }

  function nearest(x, y) {
    const now = view();
    let [best, found] = [Infinity, state.node];
    map.places.forEach((place, k) => {
      if (now.cut && Math.floor(k / map.n ** (2 - now.cut.axis)) % map.n !== now.cut.level) return;
      for (const point of [place, moved(map, k, now.factor)]) {
        const at = onScreen(point);
        const far = Math.hypot(at[0] - x, at[1] - y);
        if (far < best) [best, found] = [far, k];
      }
    });
    return found;
  }

  const DO = {
    left: () => turn(-0.2, 0), right: () => turn(0.2, 0), up: () => turn(0, 0.15), down: () => turn(0, -0.15),
    in: () => zoom(1.25), out: () => zoom(0.8), home,
  };
  const KEYS = {
    ArrowLeft: DO.left, ArrowRight: DO.right, ArrowUp: DO.up, ArrowDown: DO.down, "+": DO.in, "=": DO.in, "-": DO.out, 0: home, Home: home,
  };
  for (const button of scene.querySelectorAll("[data-do]")) button.addEventListener("click", DO[button.dataset.do]);
  canvas.addEventListener("keydown", (event) => {
    if (!KEYS[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    KEYS[event.key]();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 500));
  }, { passive: false });
  hands(canvas, { turn, zoom, pick: (x, y) => choose(nearest(x, y)) });
  for (const what of ["factor", "cut", "level", "grid", "arrows"]) field(what).addEventListener("input", () => soon(true));
  "XYZ".split("").forEach((axis, i) => {
    const select = field(`node-${axis}`);
    select.replaceChildren(...map.axes[i].map((at, k) => new Option(`${at} ${unit.place}`, String(k))));
    select.addEventListener("change", () => {
      const at = "XYZ".split("").map((a) => Number(field(`node-${a}`).value));
      choose((at[0] * map.n + at[1]) * map.n + at[2]);
    });
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    colours = styleNow(Number(scene.dataset.top));
    soon(true);
  });
  canvas.addEventListener("webglcontextlost", () => fallBack());
  new ResizeObserver(() => soon(false)).observe(canvas);
  choose(map.length.indexOf(Math.max(...map.length)));
}

// One pointer rotates, two zoom; a click without movement selects.
function hands(canvas, act) {
  const down = new Map();
  let travelled = 0;
  const gap = () => { const [a, b] = [...down.values()]; return Math.hypot(a.x - b.x, a.y - b.y); };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    if (down.size === 0) travelled = 0;
    down.set(event.pointerId, { x: event.offsetX, y: event.offsetY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = down.get(event.pointerId);
    if (!last) return;
    const before = down.size === 2 ? gap() : 0;
    const [dx, dy] = [event.offsetX - last.x, event.offsetY - last.y];
    travelled += Math.hypot(dx, dy);
    down.set(event.pointerId, { x: event.offsetX, y: event.offsetY });
    if (down.size === 2 && before > 0) act.zoom(gap() / before);
    else if (down.size === 1) act.turn(dx * 0.008, dy * 0.008);
  });
  canvas.addEventListener("pointerup", (event) => {
    if (down.size === 1 && travelled < 5) act.pick(event.offsetX, event.offsetY);
    down.delete(event.pointerId);
  });
  canvas.addEventListener("pointercancel", (event) => down.delete(event.pointerId));
}

function fallBack(text) {
  scene.hidden = true;
  note.hidden = false;
  if (text) note.textContent = text;
  document.documentElement.dataset.plotted ??= "none";
}

async function begin() {
  const leave = new AbortController();
  const asked = fetch(scene.dataset.source, { signal: leave.signal }).catch(() => null); // on its way while the shaders are compiled
  const paint = painter(scene.querySelector("canvas"));
  if (!paint) {
    leave.abort();
    return fallBack();
  }
  const answer = await asked;
  if (!answer?.ok) return fallBack(note.dataset.lost);
  const map = prepared(await answer.json(), unit);
  scene.hidden = false; // only now: its selection lists were empty before
  note.hidden = true;
  start(map, paint);
}

if (scene) begin().catch((trouble) => { console.warn(trouble); fallBack(); });
