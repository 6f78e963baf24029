// Strip and polar trace of a ball-bar path on two canvases. Each pixel column (strip) or part of the path (polar) keeps its least and largest
// sample, so the effort of drawing does not depend on the rate, and every peak shows. Samples arrive in µm; `take` converts them to the
// reader's unit, so that the scales are round numbers in it.

const STRIP_S = 20;
const PARTS = 1440;
const SCALES = [1, 2, 5].flatMap((first) => [1, 10, 100, 1e3, 1e4, 1e5].map((power) => first * power)).sort((a, b) => a - b);

export function colours(canvas) {
  const style = getComputedStyle(canvas);
  const of = (name) => style.getPropertyValue(name).trim();
  return { line: of("--line"), text: of("--quiet"), trace: of("--accent") };
}

function scaleFor(size) {
  return SCALES.find((one) => one >= size) ?? SCALES.at(-1);
}

export class Traces {
  constructor(strip, polar, unit) {
    this.unit = unit;
    this.strip = strip;
    this.polar = polar;
    this.begin({ number: 0, angle_deg: [], rate_hz: 100, duration_s: 1 });
  }

  // As many pixels as the screen has, so that lines and digits are sharp; a later change of size only scales them.
  fit() {
    this.dot = globalThis.devicePixelRatio || 1;
    for (const canvas of [this.strip, this.polar]) {
      if (!canvas.clientWidth) continue;
      canvas.width = Math.round(canvas.clientWidth * this.dot);
      canvas.height = Math.round(canvas.clientHeight * this.dot);
    }
  }

  begin(path) {
    this.path = path;
    this.fit();
    this.columns = this.strip.width;
    this.perColumn = Math.max(1, Math.round((STRIP_S * path.rate_hz) / this.columns));
    this.low = new Float32Array(this.columns).fill(NaN);
    this.high = new Float32Array(this.columns).fill(NaN);
    this.partLow = new Float32Array(PARTS).fill(NaN);
    this.partHigh = new Float32Array(PARTS).fill(NaN);
    this.column = -1;
    this.drawnPart = 0;
    this.part = -1;
    this.count = 0;
    this.last = NaN;
    this.least = Infinity;
    this.most = -Infinity;
    this.scale = 0;
    this.before = null;
    this.drawPolar(true);
    this.drawStrip();
  }

  // The same path of the last check that passed: one value, in µm, for each equal part of it.
  showBefore(values) {
    this.before = values.map((value) => (value === null ? NaN : value / this.unit.size));
    this.drawPolar(true);
  }

  take(first, values) {
    const whole = Math.max(1, this.path.rate_hz * this.path.duration_s);
    for (let k = 0; k < values.length; k++) {
      const number = first + k;
      const column = Math.floor(number / this.perColumn);
      this.advance(column);
      const value = values[k] / this.unit.size;
      if (Number.isNaN(value)) continue;
      if (column > this.column - this.columns) widen(this.low, this.high, column % this.columns, value);
      const part = Math.min(PARTS - 1, Math.floor((number / whole) * PARTS));
      widen(this.partLow, this.partHigh, part, value);
      if (part > this.part) this.part = part;
      if (value < this.least) this.least = value;
      if (value > this.most) this.most = value;
      this.last = value;
    }
    this.count = Math.max(this.count, first + values.length);
  }

  // Clear skipped columns, which still have samples of the previous round of the ring.
  advance(column) {
    if (column <= this.column) return;
    const from = Math.max(this.column + 1, column - this.columns + 1);
    for (let k = from; k <= column; k++) this.low[k % this.columns] = this.high[k % this.columns] = NaN;
    this.column = column;
  }

  draw() {
    const scale = scaleFor(Math.max(Math.abs(this.least), Math.abs(this.most), 1e-3));
    const changed = Number.isFinite(this.least) && scale !== this.scale;
    if (changed) this.scale = scale;
    this.drawStrip();
    this.drawPolar(changed);
  }

  drawStrip() {
    const pen = this.strip.getContext("2d");
    const { width, height } = this.strip;
    const paint = colours(this.strip);
    pen.clearRect(0, 0, width, height);
    pen.lineWidth = this.dot;
    pen.strokeStyle = paint.line;
    pen.beginPath();
    for (let k = 1; k < 4; k++) {
      pen.moveTo(0, (k * height) / 4);
      pen.lineTo(width, (k * height) / 4);
    }
    pen.stroke();
    if (!this.scale) return;
    pen.fillStyle = paint.text;
    pen.font = `${12 * this.dot}px system-ui, sans-serif`;
    pen.fillText(`+${this.scale} ${this.unit.sign}`, 4 * this.dot, 14 * this.dot);
    pen.fillText("0", 4 * this.dot, height / 2 - 4 * this.dot);
    pen.fillText(`−${this.scale} ${this.unit.sign}`, 4 * this.dot, height - 6 * this.dot);
    pen.strokeStyle = paint.trace;
    pen.beginPath();
    const begin = Math.max(0, this.column - this.columns + 1);
    const y = (value) => (0.5 - (0.5 * value) / this.scale) * height;
    let before = NaN;
    for (let column = begin; column <= this.column; column++) {
      const low = this.low[column % this.columns];
      const high = this.high[column % this.columns];
      if (Number.isNaN(low)) {
        before = NaN;
        continue;
      }
      const x = column - begin + 0.5;
      if (Number.isNaN(before)) pen.moveTo(x, y(high));
      else pen.lineTo(x, y(high));
      pen.lineTo(x, y(low) + 0.5);
      before = low;
    }
    pen.stroke();
  }

  drawPolar(anew) {
    const pen = this.polar.getContext("2d");
    const { width, height } = this.polar;
    const middle = width / 2;
    const zero = 0.32 * width;
    const paint = colours(this.polar);
    if (anew) {
      this.drawnPart = 0;
      pen.clearRect(0, 0, width, height);
      pen.lineWidth = this.dot;
      pen.strokeStyle = paint.line;
      pen.beginPath();
      for (const radius of [zero - 0.14 * width, zero, zero + 0.14 * width]) {
        pen.moveTo(middle + radius, middle);
        pen.arc(middle, middle, radius, 0, 2 * Math.PI);
      }
      pen.moveTo(0, middle);
      pen.lineTo(width, middle);
      pen.moveTo(middle, 0);
      pen.lineTo(middle, height);
      pen.stroke();
      if (this.scale) {
        pen.fillStyle = paint.text;
        pen.font = `${12 * this.dot}px system-ui, sans-serif`;
        const rings = [[-0.14, `−${this.scale}`], [0, "0"], [0.14, `+${this.scale} ${this.unit.sign}`]];
        for (const [off, text] of rings) pen.fillText(text, middle + 4 * this.dot, Math.max(13 * this.dot, middle - zero - off * width - 4 * this.dot));
      }
    }
    if (!this.scale || this.part < 0) return;
    if (anew && this.before) this.drawBefore(pen, paint.text);
    pen.strokeStyle = paint.trace;
    pen.lineWidth = 1.2 * this.dot;
    pen.beginPath();
    let joined = false;
    const from = Math.max(0, this.drawnPart - 1);
    for (let part = from; part <= this.part; part++) {
      const low = this.partLow[part];
      if (Number.isNaN(low)) {
        joined = false;
        continue;
      }
      for (const value of [low, this.partHigh[part]]) {
        const radius = zero + (0.14 * width * value) / this.scale;
        const angle = this.angle((part + 0.5) / PARTS);
        const x = middle + radius * Math.cos(angle);
        const y = middle - radius * Math.sin(angle);
        if (joined) pen.lineTo(x, y);
        else pen.moveTo(x, y);
        joined = true;
      }
    }
    pen.stroke();
    this.drawnPart = this.part;
  }

  drawBefore(pen, colour) {
    const { width } = this.polar;
    pen.save();
    pen.strokeStyle = colour;
    pen.globalAlpha = 0.6;
    pen.lineWidth = this.dot;
    pen.beginPath();
    let joined = false;
    for (const [k, value] of this.before.entries()) {
      const radius = 0.32 * width + (0.14 * width * value) / this.scale;
      const angle = this.angle((k + 0.5) / this.before.length);
      if (Number.isFinite(radius)) pen[joined ? "lineTo" : "moveTo"](width / 2 + radius * Math.cos(angle), width / 2 - radius * Math.sin(angle));
      joined = Number.isFinite(radius);
    }
    pen.stroke();
    pen.restore();
  }

  angle(share) {
    const angles = this.path.angle_deg;
    const at = share * (angles.length - 1);
    const k = Math.min(Math.floor(at), angles.length - 2);
    return ((angles[k] + (at - k) * (angles[k + 1] - angles[k])) * Math.PI) / 180;
  }
}

function widen(low, high, at, value) {
  if (!(low[at] <= value)) low[at] = value;
  if (!(high[at] >= value)) high[at] = value;
}

// A message contains frames in sequence: version, path, first sample, count, arrival of the last sample, then the values.
export function* framesOf(buffer) {
  const view = new DataView(buffer);
  for (let at = 0; at + 24 <= buffer.byteLength; ) {
    const count = view.getUint32(at + 12, true);
    if (view.getUint32(at, true) !== 1 || at + 24 + 4 * count > buffer.byteLength) return;
    yield {
      path: view.getUint32(at + 4, true),
      first: view.getUint32(at + 8, true),
      arrivedMs: view.getFloat64(at + 16, true),
      values: new Float32Array(buffer, at + 24, count),
    };
    at += 24 + 4 * count;
  }
}
