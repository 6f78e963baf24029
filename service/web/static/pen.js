// What the curves are drawn with: colours of the page, marks of verdicts, lines within a plot.

export function paint() {
  const style = getComputedStyle(document.documentElement);
  const of = (name) => style.getPropertyValue(name).trim();
  const found = Object.fromEntries(["line", "text", "quiet", "accent", "fail", "pass", "unclear", "card"].map((name) => [name, of(`--${name}`)]));
  return { ...found, faint: `color-mix(in srgb, ${found.quiet} 55%, ${found.card})` };
}

// The mark of a verdict as a picture: circle, rhomb, cross.
export function markOf(verdict, colour) {
  const r = devicePixelRatio;
  const half = Math.ceil(7 * r);
  const sheet = document.createElement("canvas");
  sheet.width = sheet.height = 2 * half;
  const pen = sheet.getContext("2d");
  pen.translate(half, half);
  pen.scale(r, r);
  pen.strokeStyle = pen.fillStyle = colour;
  pen.lineWidth = 2.5;
  if (verdict === "fail") pen.stroke(new Path2D("M-5-5 5 5M-5 5 5-5"));
  else pen.fill(new Path2D({ pass: "M-4 0a4 4 0 1 0 8 0a4 4 0 1 0-8 0", "cannot tell": "M0-5 5 0 0 5-5 0Z" }[verdict]));
  return sheet;
}

export function line(pen, points, colour, { dash = [], width = 1 } = {}) {
  pen.save();
  pen.strokeStyle = colour;
  pen.lineWidth = width * devicePixelRatio;
  pen.setLineDash(dash.map((one) => one * devicePixelRatio));
  pen.beginPath();
  points.forEach(([x, y], k) => (k ? pen.lineTo(x, y) : pen.moveTo(x, y)));
  pen.stroke();
  pen.restore();
}

// The part of a line that is in the plot: a dashed one would be cut into dashes for all its length, however far one has zoomed in.
export function within([ax, ay], [bx, by], { left, width }) {
  const ends = [Math.max(ax, left), Math.min(bx, left + width)];
  return ends[0] < ends[1] ? ends.map((x) => [x, ay + ((by - ay) * (x - ax)) / (bx - ax)]) : [];
}

export function inside(u, draw) {
  const { ctx: pen, bbox } = u;
  pen.save();
  pen.beginPath();
  pen.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  pen.clip();
  draw(pen, (x) => u.valToPos(x, "x", true), (y) => u.valToPos(y, "y", true), bbox);
  pen.restore();
}
