// The machine beside the traces: axis positions, feed, door and air; and, where no path is recorded, the laser over the last minute.

import { colours } from "./traces.js";

const MINUTE_MS = 60_000;
// The core shows no answer that is older; here it is counted from the arrival, since the clocks of panel and service may differ.
const OLD_MS = 5000;
const find = (id) => document.getElementById(id);

function setText(id, text) {
  const element = find(id);
  if (element && element.textContent !== text) element.textContent = text;
}

function isNew(last, at) {
  if (at === last.at) return false;
  Object.assign(last, { at, seen: performance.now() });
  return true;
}

function isOld(last) {
  return performance.now() - last.seen > OLD_MS;
}

export class Machine {
  // `place` and `speed`: decimals and size of the reader's units in mm and mm/min.
  constructor(root, words) {
    this.words = words;
    this.mm = Number(root.dataset.mm);
    this.finer = this.mm > 1 ? 2 : 0;
    this.readings = [];
    this.canvas = find("strip");
    this.answer = { at: null, seen: -Infinity };
    this.laser = { at: null, seen: -Infinity };
  }

  show(reading) {
    if (reading !== null) isNew(this.answer, reading.at_ms);
    find("dro").hidden = reading === null || isOld(this.answer);
    if (reading === null) return;
    for (const [k, axis] of ["x", "y", "z"].entries()) setText(`dro-${axis}`, (reading.position_mm[k] / this.mm).toFixed(3 + this.finer));
    const feed = reading.feed_mm_min === null ? "–" : (reading.feed_mm_min / this.mm).toFixed(this.finer);
    setText("dro-feed", reading.override_percent === 100 ? feed : `${feed} (${reading.override_percent ?? "–"} %)`);
    setText("dro-door", this.words[reading.door_open ? "live.door.open" : "live.door.shut"]);
    find("dro-door").classList.toggle("fail", reading.door_open);
    setText("dro-air", reading.air_c === null ? "–" : `${reading.air_c.toFixed(1)} °C`);
    if (reading.laser_mm === null || !reading.beam_good || !isNew(this.laser, reading.laser_at_ms)) return;
    this.readings.push([reading.laser_at_ms, reading.laser_mm / this.mm]);
    while (this.readings[0][0] < reading.laser_at_ms - MINUTE_MS) this.readings.shift();
  }

  // Without a new answer the last one is not the machine any more.
  hideOld() {
    if (isOld(this.answer)) find("dro").hidden = true;
  }

  get hasLaser() {
    return this.readings.length > 1 && !isOld(this.laser);
  }

  // A path begins, or another test: the laser counts from another zero.
  forget() {
    this.readings = [];
  }

  draw(sign) {
    const pen = this.canvas.getContext("2d");
    const dot = globalThis.devicePixelRatio || 1;
    const { width, height } = this.canvas;
    const paint = colours(this.canvas);
    const values = this.readings.map(([, value]) => value);
    const [low, high] = [Math.min(...values), Math.max(...values)];
    const room = Math.max(high - low, 10 ** -(3 + this.finer));
    const newest = this.readings.at(-1)[0];
    const x = (at) => width * (1 - (newest - at) / MINUTE_MS);
    const y = (value) => height * (0.9 - (0.8 * (value - low)) / room);
    pen.clearRect(0, 0, width, height);
    pen.lineWidth = dot;
    pen.strokeStyle = paint.line;
    pen.beginPath();
    for (const at of [0.1, 0.5, 0.9]) {
      pen.moveTo(0, at * height);
      pen.lineTo(width, at * height);
    }
    pen.stroke();
    pen.fillStyle = paint.text;
    pen.font = `${12 * dot}px system-ui, sans-serif`;
    for (const [value, at] of [[high, 0.1], [low, 0.9]]) pen.fillText(`${value.toFixed(4 + this.finer)} ${sign}`, 4 * dot, at * height - 4 * dot);
    pen.strokeStyle = paint.trace;
    pen.lineWidth = 1.5 * dot;
    pen.beginPath();
    this.readings.forEach(([at, value], k) => (k ? pen.lineTo(x(at), y(value)) : pen.moveTo(x(at), y(value))));
    pen.stroke();
    setText("strip-name", this.words["live.laser.strip"]);
    setText("strip-scale", `60 s, ${sign}`);
  }
}
