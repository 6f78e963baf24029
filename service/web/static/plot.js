// Curves to work with: zoom, cursor with value and U, export. uPlot draws them; where it was not fetched the pictures beside them stay.
// A figure's series comes in `data-plot` of its box; texts in `data-words` of the list of boxes.

import { inside, line, markOf, paint, within } from "./pen.js";

const { uPlot } = globalThis;
const VERDICTS = ["pass", "cannot tell", "fail"];
const SHOWN = 6;

const number = (value) => (value === null || value === undefined ? "–" : Number(value.toPrecision(SHOWN)).toString());

function fill(text, values) {
  return text.replace(/\{(\w+)\}/g, (_, name) => values[name] ?? "");
}

// ---- one plot: its frame, hand and keyboard -------------------------------------------------------------------------------------

export class Plot {
  // `options`: those of uPlot but for size, scales and cursor; `onMove(index)`: the cursor is at a point, or left (null).
  constructor(host, options, data, height, onMove) {
    this.host = host;
    this.height = height;
    this.whole = [data[0][0], data[0].at(-1)];
    const quiet = { show: false };
    this.plot = new uPlot({
      width: Math.max(host.clientWidth, 200),
      height,
      legend: quiet,
      cursor: { drag: { x: true, y: false, uni: 20 }, points: quiet, y: false },
      ...options,
      hooks: { ...options.hooks, setCursor: [(u) => onMove(u.cursor.idx ?? null)] },
    }, data, host);
    new ResizeObserver(() => this.resize()).observe(host);
    this.touch();
  }

  resize() {
    const width = this.host.clientWidth;
    if (width && width !== this.plot.width) this.plot.setSize({ width, height: this.height });
  }

  get range() {
    const { min, max } = this.plot.scales.x;
    return [min, max];
  }

  show(min, max) {
    const [first, last] = this.whole;
    const span = Math.min(Math.max(max - min, this.least ?? (last - first) * 1e-4), last - first);
    const low = Math.min(Math.max(min, first), last - span);
    this.plot.setScale("x", { min: low, max: low + span });
  }

  zoom(factor, share = 0.5) {
    const [min, max] = this.range;
    const at = min + (max - min) * share;
    this.show(at - (at - min) * factor, at + (max - at) * factor);
  }

  move(share) {
    const [min, max] = this.range;
    this.show(min + (max - min) * share, max + (max - min) * share);
  }

  // One finger moves along, two fingers zoom; up and down scrolls the page.
  touch() {
    const { over } = this.plot;
    const fingers = new Map();
    over.addEventListener("pointerdown", (event) => { if (event.pointerType !== "mouse") fingers.set(event.pointerId, event.clientX); });
    for (const end of ["pointerup", "pointercancel"]) over.addEventListener(end, (event) => fingers.delete(event.pointerId));
    over.addEventListener("pointermove", (event) => {
      if (!fingers.has(event.pointerId)) return;
      const before = [...fingers.values()];
      fingers.set(event.pointerId, event.clientX);
      const now = [...fingers.values()];
      if (now.length === 1) this.move((before[0] - now[0]) / over.clientWidth);
      else this.zoom(Math.abs(before[0] - before[1]) / Math.max(Math.abs(now[0] - now[1]), 1));
    });
    over.addEventListener("wheel", (event) => {
      if (!event.ctrlKey) return;
      event.preventDefault();
      this.zoom(event.deltaY > 0 ? 1.25 : 0.8, event.offsetX / over.clientWidth);
    }, { passive: false });
  }
}

export function axes(values, paintNow, yLabel, xLabel) {
  const common = { stroke: paintNow.quiet, grid: { stroke: paintNow.line, width: 1 }, ticks: { stroke: paintNow.line, width: 1 }, font: "12px system-ui, sans-serif" };
  const labelled = (label) => ({ ...common, label, labelFont: common.font, labelSize: 18 });
  return [{ ...(xLabel ? labelled(xLabel) : common), ...(values ? { values } : {}) }, { ...labelled(yLabel), size: 52 }];
}

function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

// The canvases one below the other, on the colour of their card.
export function savePng(name, hosts) {
  const all = hosts.map((host) => host.querySelector("canvas"));
  const sheet = document.createElement("canvas");
  sheet.width = Math.max(...all.map((one) => one.width));
  sheet.height = all.reduce((sum, one) => sum + one.height, 0);
  const pen = sheet.getContext("2d");
  pen.fillStyle = getComputedStyle(hosts[0].closest(".card")).backgroundColor;
  pen.fillRect(0, 0, sheet.width, sheet.height);
  let top = 0;
  for (const one of all) {
    pen.drawImage(one, 0, top);
    top += one.height;
  }
  sheet.toBlob((blob) => save(blob, `${name}.png`));
}

export function saveCsv(name, rows) {
  const cell = (value) => (/[",\n]/.test(value) ? `"${value.replaceAll('"', '""')}"` : value);
  save(new Blob([rows.map((row) => row.map((one) => cell(String(one ?? ""))).join(",")).join("\n") + "\n"], { type: "text/csv" }), `${name}.csv`);
}

// ---- a box with a plot: value under the cursor, buttons, keys ---------------------------------------------------------------------

// A subclass has `build`, `say(k)` (text of a point) and `rows` (of the CSV); its data have `key`, `x`, `y`. The plot's first and last
// position (`ends`) may lie beside the data: `off` counts them.
class Box {
  constructor(box, told, words) {
    this.box = box;
    this.told = told;
    this.words = words;
    this.out = box.querySelector("output");
  }

  begin() {
    this.build();
    this.box.querySelector(".tools").hidden = false;
    this.box.addEventListener("click", (event) => this.press(event.target.closest("button")?.dataset.do));
    this.box.addEventListener("keydown", (event) => this.key(event));
    this.tell(this.told.x.length - 1);
  }

  tell(k) {
    if (k === null || k === this.at) return;
    this.at = Math.min(Math.max(k, 0), this.told.x.length - 1);
    this.say(this.at);
  }

  key(event) {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    const act = { "+": "in", "-": "out", 0: "whole" }[event.key];
    if (event.target.closest("button, a") || event.ctrlKey || event.metaKey || event.altKey || !(step || act)) return;
    event.preventDefault();
    if (act) return this.press(act);
    const { x, y } = this.told;
    const next = Math.min(Math.max(this.at + step, 0), x.length - 1);
    const { plot } = this.main;
    plot.setCursor({ left: plot.valToPos(x[next], "x"), top: plot.valToPos(y[next], "y") });
    this.tell(next);
  }

  press(what) {
    const { main, told } = this;
    if (what === "in") main.zoom(0.5, Math.min(Math.max((told.x[this.at] - main.range[0]) / (main.range[1] - main.range[0]), 0), 1));
    if (what === "out") main.zoom(2);
    if (what === "left") main.move(-0.5);
    if (what === "right") main.move(0.5);
    if (what === "whole") main.show(...main.whole);
    if (what === "png") savePng(told.key, [...this.box.querySelectorAll("[data-part]")]);
    if (what === "csv") saveCsv(told.key, this.rows());
  }
}

// ---- a curve with its band of U -------------------------------------------------------------------------------------------------

class Curve extends Box {
  constructor(box) {
    super(box, JSON.parse(box.dataset.curve), JSON.parse(box.dataset.words));
    this.begin();
  }

  build() {
    const { told } = this;
    const colours = paint();
    const host = this.box.querySelector("[data-part=main]");
    host.replaceChildren();
    const [low, high] = [-1, 1].map((sign) => told.y.map((y, k) => y + sign * told.u[k]));
    const most = Math.max(...high.map(Math.abs), ...low.map(Math.abs)) * 1.06 || 1;
    const edge = { stroke: "transparent", points: { show: false } };
    this.main = new Plot(host, {
      scales: { x: { time: false, range: (_, min, max) => [min, max] }, y: { range: [Math.min(0, ...low) * 1.06 || -0.05 * most, Math.max(0, ...high) * 1.06 || 0.05 * most] } },
      padding: [12, 20, 0, 0],
      axes: axes(null, colours, `${told.name} [${told.unit}]`, told.x_name),
      series: [{}, { stroke: colours.accent, width: 2, dash: told.dashed ? [6, 4] : [], points: { show: false } }, edge, edge],
      bands: [{ series: [3, 2], fill: `${colours.accent}33` }],
    }, [told.x, told.y, low, high], 300, (at) => this.tell(at));
  }

  say(k) {
    const { told } = this;
    this.out.textContent = fill(this.words["plot.value"], { at: told.x_name.replace(" [", ` = ${number(told.x[k])} `).replace("]", ""), value: told.shown[k][0], u: told.shown[k][1], unit: told.unit });
  }

  rows() {
    const { told } = this;
    return [[told.x_name, `${told.key} [${told.unit}]`, `U (k=2) [${told.unit}]`], ...told.x.map((x, k) => [x, told.y[k], told.u[k]])];
  }
}

// ---- the readings of a run: the service sends what a screen can show, and more of it as one zooms ------------------------------

const PAUSE_MS = 120;

class Readings extends Box {
  static async of(box) {
    const told = await readings(box.dataset.run);
    if (!told || told.x.length < 2) return;
    box.hidden = false;
    const [x_name, y_name] = JSON.parse(box.dataset.labels);
    new Readings(box, { ...told, key: box.dataset.name, x_name, y_name, unit: box.dataset.unit, y: told.high }, JSON.parse(box.dataset.words)).begin();
    document.documentElement.dataset.plotted = "yes";
  }

  build() {
    const { told } = this;
    const colours = paint();
    const host = this.box.querySelector("[data-part=main]");
    host.replaceChildren();
    const line = { stroke: colours.accent, width: 1, points: { show: false } };
    this.begun = false;
    this.main = new Plot(host, {
      scales: { x: { time: false, range: (_, min, max) => [min, max] }, y: { range: (_, min, max) => uPlot.rangeNum(min, max, 0.08, true) } },
      padding: [12, 20, 0, 0],
      axes: axes(null, colours, told.y_name, told.x_name),
      series: [{}, line, line],
      bands: [{ series: [2, 1], fill: `${colours.accent}55` }],
      hooks: { setScale: [(u, key) => key === "x" && this.ask()] },
    }, [told.x, told.low, told.high], 320, (at) => this.tell(at));
    this.main.whole = told.whole;
  }

  ask() {
    // The first range is that of the readings that are here.
    if (!this.begun) { this.begun = true; return; }
    clearTimeout(this.waiting);
    this.waiting = setTimeout(async () => {
      const { main, told } = this;
      if (!main) return;
      const [min, max] = main.range;
      const found = await readings(this.box.dataset.run, min, max);
      if (!found || main.range[0] !== min || main.range[1] !== max) return;
      Object.assign(told, found, { y: found.high });
      main.plot.setData([told.x, told.low, told.high], false);
      main.plot.redraw();
      this.box.dataset.shown = `${min} ${max}`;
    }, PAUSE_MS);
  }

  say(k) {
    const { told } = this;
    const [low, high] = [told.low[k], told.high[k]].map(number);
    this.out.textContent = fill(this.words["plot.read"], { at: `${number(told.x[k])} s`, value: low === high ? low : `${low} … ${high}`, unit: told.unit });
  }

  rows() {
    const { told } = this;
    return [[told.x_name, `low [${told.unit}]`, `high [${told.unit}]`], ...told.x.map((x, k) => [x, told.low[k], told.high[k]])];
  }
}

// The whole run comes with the page: its address is that of the preload.
async function readings(run, ...between) {
  const part = between.length ? `&low=${between[0]}&high=${between[1]}` : "";
  const answer = await fetch(`/run/curve?id=${run}${part}`).catch(() => null);
  return answer?.ok ? answer.json() : null;
}

// ---- the trend of a figure ------------------------------------------------------------------------------------------------------

class Trend extends Box {
  constructor(box, words) {
    super(box, opened(JSON.parse(box.dataset.plot)), words);
    this.begin();
  }

  build() {
    const { told, words } = this;
    const colours = paint();
    const own = [colours.pass, colours.unclear, colours.fail];
    this.marks = [own, own.map(() => colours.faint)].map((list) => list.map((colour, k) => markOf(VERDICTS[k], colour)));
    const date = zoned(told.zone);
    const days = (u, splits) => splits.map((at) => {
      const [min, max] = [u.scales.x.min, u.scales.x.max];
      const [, y, m, d, clock] = /(\d{4})-(\d\d)-(\d\d) (\d\d:\d\d)/.exec(stamp(date(at)));
      return max - min < 4 * 86400 ? `${m}-${d} ${clock}` : max - min < 700 * 86400 ? `${m}-${d}` : `${y}-${m}`;
    });
    const last = told.x.at(-1);
    const most = told.cone ? Math.min(told.cone.high, last + 0.6 * (last - told.x[0]) + 86400) : last;
    const margin = Math.max((most - told.x[0]) * 0.03, 60);
    const ends = [told.x[0] - margin, most + margin];
    const high = told.y.map((y, k) => y + told.u[k]);
    const low = told.y.map((y, k) => y - told.u[k]);
    const limits = told.limit.filter((one) => one !== null);
    const top = Math.max(...high, ...limits, told.centre ?? -Infinity) * 1.06;
    const scales = { x: { time: true, range: (_, min, max) => [min, max] }, y: { range: [Math.min(0, ...low), top] } };
    const main = this.box.querySelector("[data-part=main]");
    const below = this.box.querySelector("[data-part=chart]");
    main.replaceChildren();
    below.replaceChildren();
    const padded = (list) => [null, ...list, null];
    this.main = new Plot(main, {
      scales, tzDate: date, padding: [12, 20, 0, 0],
      axes: axes(days, colours, `${told.name} [${told.unit}]`),
      series: [{}, { paths: () => null, points: { show: false } }],
      hooks: { drawAxes: [(u) => this.behind(u, colours)], draw: [(u) => this.points(u, colours)], setScale: [(u, key) => key === "x" && this.follow(u)] },
    }, [[ends[0], ...told.x, ends[1]], padded(told.y)], 300, (at) => this.tell(at === null ? null : at - 1));
    const { chart } = told;
    const of = (list, by) => list.map((one, k) => (one === null ? null : one / by(k)));
    const curve = (stroke, dash) => ({ stroke, dash, width: 1, spanGaps: true, points: { show: false } });
    this.chart = new Plot(below, {
      scales: { x: scales.x, y: { range: (_, min, max) => [Math.min(-1.15, min ?? 0), Math.max(1.15, max ?? 0)] } },
      tzDate: date, padding: [6, 20, 0, 0],
      axes: axes(days, colours, words["plot.share"]),
      series: [{}, curve(colours.accent), curve(colours.accent, [2, 3]), curve(colours.unclear)],
      hooks: { draw: [(u) => inside(u, (pen, x, y, b) => {
        for (const one of [1, -1]) line(pen, [[b.left, y(one)], [b.left + b.width, y(one)]], colours.fail, { dash: [6, 4] });
      })] },
    }, [[ends[0], ...told.x, ends[1]], padded(of(chart.high, () => chart.h)), padded(of(chart.low, () => -chart.h)), padded(of(chart.ewma, (k) => chart.ewma_limit[k]))], 150, (at) => this.tell(at === null ? null : at - 1));
    // Closer than a few checks there is nothing to be seen.
    this.main.least = 4 * Math.max(Math.min(...told.x.slice(1).map((at, k) => at - told.x[k])), 60);
    this.main.show(...ends);
  }

  follow(u) {
    const { min, max } = u.scales.x;
    if (this.chart && (this.chart.range[0] !== min || this.chart.range[1] !== max)) this.chart.plot.setScale("x", { min, max });
  }

  // Centre line, forecast and marks lie behind the points.
  behind(u, colours) {
    const { told } = this;
    inside(u, (pen, x, y, b) => {
      if (told.centre !== null) line(pen, [[x(told.begins), y(told.centre)], [b.left + b.width, y(told.centre)]], colours.quiet);
      if (told.cone) {
        const { at, value, low, days, high, limit } = told.cone;
        pen.fillStyle = colours.accent;
        pen.globalAlpha = 0.18;
        pen.beginPath();
        for (const [cx, cy] of [[at, value], [low, limit], [high, limit]]) pen.lineTo(x(cx), y(cy));
        pen.fill();
        pen.globalAlpha = 1;
        line(pen, within([x(at), y(value)], [x(days), y(limit)], b), colours.accent, { dash: [8, 4], width: 1.5 });
      }
      const [from, to] = [u.scales.x.min, u.scales.x.max];
      for (const [k, [ax, level, bx, next]] of told.limits.entries()) {
        if (k && ax > to || bx < from && k < told.limits.length - 1) continue;
        const first = k ? x(ax) : Math.min(x(ax), b.left);
        const last = k < told.limits.length - 1 ? x(bx) : Math.max(x(bx), b.left + b.width);
        line(pen, within([first, y(level)], [last, y(next)], b), colours.fail, { dash: [6, 4] });
      }
      pen.font = `${12 * devicePixelRatio}px system-ui, sans-serif`;
      pen.textAlign = "center";
      for (const mark of told.marks) {
        const bad = mark.kind === "alarm";
        line(pen, [[x(mark.at), b.top], [x(mark.at), b.top + b.height]], bad ? colours.fail : colours.quiet, { dash: [2, 4], width: 1.5 });
        pen.fillStyle = bad ? colours.fail : colours.text;
        pen.fillText(mark.sign, x(mark.at), b.top + 12 * devicePixelRatio);
      }
    });
  }

  // Rectangles and pictures of the marks: a browser without a GPU takes ten times as long for arcs and strokes of a year of points.
  points(u, colours) {
    const { told } = this;
    const r = devicePixelRatio;
    const { min, max } = u.scales.x;
    inside(u, (pen, x, y, b) => {
      const seen = [...told.x.keys()].filter((k) => told.x[k] >= min && told.x[k] <= max).map((k) => [k, Math.round(x(told.x[k])), y(told.y[k])]);
      const caps = seen.length * 8 * r < b.width;
      for (const [k, px] of seen) {
        if (!told.u[k]) continue;
        const [top, bottom] = [y(told.y[k] + told.u[k]), y(told.y[k] - told.u[k])];
        pen.fillStyle = k < told.earlier ? colours.faint : colours.quiet;
        pen.fillRect(px - 0.6 * r, top, 1.2 * r, bottom - top);
        for (const at of caps ? [top, bottom] : []) pen.fillRect(px - 4 * r, at - 0.6 * r, 8 * r, 1.2 * r);
      }
      for (const [k, px, py] of seen) {
        const mark = this.marks[k < told.earlier ? 1 : 0][told.verdict[k]];
        pen.drawImage(mark, px - mark.width / 2, Math.round(py) - mark.height / 2);
      }
    });
  }

  when(at) {
    return stamp(zoned(this.told.zone)(at));
  }

  say(k) {
    const { told, words } = this;
    const { high, low, h, ewma } = told.chart;
    const value = fill(words["plot.at"], {
      when: this.when(told.x[k]), value: told.shown[k][0], u: told.shown[k][1], unit: told.unit,
      verdict: words[`verdict.${VERDICTS[told.verdict[k]]}`], check: told.check[k],
    });
    const chart = high[k] === null ? "" : ` · CUSUM ↑ ${high[k].toFixed(1)} ↓ ${low[k].toFixed(1)} (${h}) · EWMA ${ewma[k] === null ? "–" : ewma[k].toFixed(2)}`;
    const marks = told.marks.filter((mark) => Math.abs(mark.at - told.x[k]) < 43200).map((mark) => ` · ${mark.sign} ${mark.text}`);
    this.out.textContent = value + chart + marks.join("");
    const link = this.box.querySelector("a.open");
    link.hidden = false;
    link.href = `/check?id=${told.check[k]}`;
    link.textContent = fill(words["check.open"], { n: told.check[k] });
  }

  rows() {
    const { told } = this;
    const head = ["check", "time", `${told.key} [${told.unit}]`, `U (k=2) [${told.unit}]`, `limit [${told.unit}]`, "verdict", "CUSUM high", "CUSUM low", "EWMA"];
    return [head, ...told.x.map((at, k) => {
      const chart = [told.chart.high[k], told.chart.low[k], told.chart.ewma[k]];
      return [told.check[k], new Date(at * 1e3).toISOString(), told.y[k], told.u[k] || "", told.limit[k], VERDICTS[told.verdict[k]], ...chart];
    })];
  }
}

// The series as they are drawn: value and U come as text, a limit as the points from which it holds.
function opened(told) {
  const texts = [told.value, told.u].map((text) => text.split(" "));
  const [y, u] = texts.map((list) => list.map((text) => Number(text.replace("−", "-"))));
  u.forEach((one, k) => { if (Number.isNaN(one)) u[k] = 0; });
  for (const [k, value] of told.bare) y[k] = value;
  const limit = told.x.map((_, k) => told.limit.findLast(([from]) => from <= k)[1]);
  const begins = told.x[told.chart.high.findIndex((one) => one !== null)];
  return { ...told, y, u, limit, limits: parts(told.x, limit), begins, shown: texts[0].map((text, k) => [text, texts[1][k]]) };
}

// A line of levels as its straight parts: from where and which, to where and which.
function parts(x, levels) {
  const known = [...x.keys()].filter((k) => levels[k] !== null && !(levels[k] === levels[k - 1] && levels[k] === levels[k + 1]));
  if (known.length === 1) return [[x[known[0]], levels[known[0]], x[known[0]], levels[known[0]]]];
  return known.slice(0, -1).map((k, n) => [x[k], levels[k], x[known[n + 1]], levels[known[n + 1]]]);
}

// Times in s since 1970 as dates that are shifted to a zone. One formatter for all: uPlot's own makes one for each tick of each frame.
const zones = new Map();

function zoned(zone) {
  if (!zones.has(zone)) {
    const parts = { year: "numeric", month: "numeric", day: "numeric", hour: "numeric", minute: "numeric", second: "numeric" };
    const format = new Intl.DateTimeFormat("en-US", { ...parts, timeZone: zone, hourCycle: "h23" });
    zones.set(zone, (at) => {
      const of = Object.fromEntries(format.formatToParts(at * 1e3).map(({ type, value }) => [type, Number(value)]));
      return new Date(of.year, of.month - 1, of.day, of.hour, of.minute, of.second);
    });
  }
  return zones.get(zone);
}

// A date that was shifted to the zone, as on the other screens.
function stamp(date) {
  const two = (n) => String(n).padStart(2, "0");
  return `${date.getFullYear()}-${two(date.getMonth() + 1)}-${two(date.getDate())} ${two(date.getHours())}:${two(date.getMinutes())}`;
}

const boxes = [];
if (uPlot) {
  const list = document.getElementById("trend-plots");
  const words = list ? JSON.parse(list.dataset.words) : {};
  boxes.push(...[...document.querySelectorAll("[data-plot]")].map((box) => new Trend(box, words)));
  boxes.push(...[...document.querySelectorAll("[data-curve]")].map((box) => new Curve(box)));
  document.querySelectorAll("[data-run]").forEach((box) => Readings.of(box));
  document.getElementById("still")?.remove();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => boxes.forEach((one) => one.build()));
  document.documentElement.dataset.plotted = "yes";
}
